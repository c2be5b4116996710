"""Faults of what is shown, a kind a file."""
