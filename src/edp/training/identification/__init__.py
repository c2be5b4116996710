"""Identification of the simulator's machine from grey-box parameters: coordinates, bodies, intervals, machine file."""
