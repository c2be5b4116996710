"""The animated page of a simulation, and its film."""
