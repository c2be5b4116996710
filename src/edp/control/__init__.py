"""Closed loops: tasks of the bucket tip, controllers that follow them, and plants exchanged by one argument."""
