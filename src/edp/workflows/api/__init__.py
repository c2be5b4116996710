"""Public Python API: the names that ``import edp`` offers. Each module is imported on first use of one of its names."""
