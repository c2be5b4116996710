"""MAT files: size check before unpacking, and the signals in them."""

from edp.logs.formats.matlab.variables import INFO, MAGIC, MatVariables, Part, is_v4

__all__ = ["INFO", "MAGIC", "MatVariables", "Part", "is_v4"]
