"""Public Python API: the names of ``import edp``. The first use of a name imports its module."""
