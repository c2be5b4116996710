"""Public Python API: the names of ``import edp``. A module is imported on first use of one of its names."""
