"""Faults of the machine, a kind a file."""
