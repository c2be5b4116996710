"""W8A16 networks in integer arithmetic: 8-bit weights, 16-bit values, defined bit for bit."""

from edp.ir.w8a16.calibration import calibrate
from edp.ir.w8a16.quantise import Formats, quantise
from edp.ir.w8a16.reference import Integers

__all__ = ["Formats", "Integers", "calibrate", "quantise"]
