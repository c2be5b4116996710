"""Machines: parameters, machine files, and random families around one machine."""
