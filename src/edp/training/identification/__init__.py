"""Parameters of the simulator's machine from those of a grey box: coordinates, bodies, intervals, machine file."""
