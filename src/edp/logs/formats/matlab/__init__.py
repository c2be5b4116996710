"""MAT files: what they announce, and what is found in them."""

from edp.logs.formats.matlab.variables import INFO, MAGIC, MatVariables, Part, is_v4

__all__ = ["INFO", "MAGIC", "MatVariables", "Part", "is_v4"]
