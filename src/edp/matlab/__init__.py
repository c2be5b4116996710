"""MAT files, unpacked in a process of its own: damaged ones crash, hang or exhaust the libraries that read them."""

from edp.matlab.apart import end, unpack
from edp.matlab.found import INFO, MAGIC, Found, Part, is_v4

__all__ = ["INFO", "MAGIC", "Found", "Part", "end", "is_v4", "unpack"]
