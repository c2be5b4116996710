"""Sensor faults, one module per fault type."""
