"""MAT files: what they announce, and what is found in them."""

from edp.matlab.found import INFO, MAGIC, Found, Part, is_v4

__all__ = ["INFO", "MAGIC", "Found", "Part", "is_v4"]
