"""Equations of the machine: linkage, hydraulics, soil, heat, and their integration."""
