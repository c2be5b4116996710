"""W8A16: networks in whole numbers, 8-bit weights and 16-bit values, and what they compute to the last bit."""

from edp.integer.calibration import calibrate
from edp.integer.quantise import Formats, quantise
from edp.integer.reference import Integers

__all__ = ["Formats", "Integers", "calibrate", "quantise"]
