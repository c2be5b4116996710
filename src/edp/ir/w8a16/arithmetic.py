"""Integer arithmetic of W8A16 networks, the same bits in NumPy and in C.

A value is ``q 2^-frac`` with q a 16-bit number in [-32767, 32767]; `frac` may be negative or beyond 15. Accumulators
have 32 bits; their product with a scale has 64 bits. Every rounding is half up, every overflow saturates.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ExportError
from edp.wording import typed

Fixed = NDArray[np.int64]
"""Integer array of any width. NumPy computes with 64 bits, and `saturated` limits values to their width."""

LARGEST = 32767
"""Largest magnitude of an activation."""
WEIGHT = 127
"""Largest magnitude of a weight."""
ACCUMULATOR = 2**31 - 1
GATE_FRAC = 16
"""Number of fractional bits of gates and attention scores, 32-bit."""
CELL_FRAC = 20
"""Number of fractional bits of an LSTM cell state, 32-bit."""
UNIT_FRAC = 15
"""Number of fractional bits of values between -1 and 1."""
GATE_LIMIT = 2**28
CELL_LIMIT = 2**30
TABLE = 513
"""Number of entries of a function table. Values between entries are interpolated."""


def frac_for(largest: float, bits: int = 15) -> int:
    """Return the largest number of fractional bits with which `largest` fits in `bits` bits and a sign."""
    # NaN and zero give the finest format: a value that never moves needs no range.
    if not largest > 0.0:
        return bits
    frac = math.floor(math.log2((2**bits - 1) / largest))
    return max(-bits, min(2 * bits, frac))


def round_shift(x: Any, bits: int) -> Fixed:
    """Return ``x 2^-bits``, rounded half up."""
    # Half up rather than half to even: one addition and a shift in C.
    x = np.asarray(x, dtype=np.int64)
    if bits <= 0:
        return np.asarray(x << -bits)
    return np.asarray((x + (1 << (bits - 1))) >> bits)


def saturated(x: Any, largest: int = LARGEST) -> Fixed:
    """Limit values to [-largest, largest]."""
    return np.clip(np.asarray(x, dtype=np.int64), -largest, largest)


def to_fixed(values: Any, frac: int, largest: int = LARGEST) -> Fixed:
    """Convert real values to integers, rounded half up and limited to the range."""
    scaled = np.floor(np.asarray(values, dtype=np.float64) * 2.0**frac + 0.5)
    return np.clip(scaled, -largest, largest).astype(np.int64)


def factor(real: Any) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Return the positive factors as ``multiplier 2^-shift``, multipliers of 31 bits, shifts between 1 and 62.

    Raises:
        ExportError: a factor of 2^30 and more.
    """
    values = np.asarray(real, dtype=np.float64)
    mantissa, exponent = np.frexp(values)
    # Rounding up can carry a mantissa to 2^31, one bit too many for the multiplier.
    multiplier = np.floor(mantissa * 2.0**31 + 0.5)
    over = multiplier >= 2.0**31
    multiplier, exponent = np.where(over, 2.0**30, multiplier), np.where(over, exponent + 1, exponent)
    shift = 31 - exponent
    if (shift < 1).any():
        raise ExportError(
            f"a factor of {typed(values.max(), 3)} between two formats is beyond 2^30: their ranges differ too much"
        )
    small = shift > 62  # A factor this small is no more than zero after rounding.
    return np.where(small, 0, multiplier).astype(np.int32), np.where(small, 62, shift).astype(np.uint8)


def scaled(accumulator: Any, multiplier: Any, shift: Any) -> Fixed:
    """Return ``accumulator multiplier 2^-shift`` rounded half up; accumulators of 32 bits."""
    shift = np.asarray(shift, dtype=np.int64)
    product = np.asarray(accumulator, dtype=np.int64) * np.asarray(multiplier, dtype=np.int64)
    # A product of 32 and 31 bits needs 63: `int64` holds it in NumPy and in C.
    return np.asarray((product + (np.int64(1) << (shift - 1))) >> shift)


def _table(function: Any, last: float) -> NDArray[np.uint16]:
    at = np.linspace(0.0, last, TABLE)
    values = np.array([function(float(x)) for x in at])
    # 16 bits unsigned: 1.0 saturates at 65535 / 65536, below the resolution of the values.
    return np.clip(np.floor(values * 65536.0 + 0.5), 0, 65535).astype(np.uint16)


# Beyond 8, tanh is 1 to within 2^-16; one table serves tanh and sigmoid.
TANH = _table(math.tanh, 8.0)
"""Table of tanh on [0, 8], in 2^-16."""
EXP = _table(lambda x: math.exp(-x), 16.0)
"""Table of exp(-x) on [0, 16], in 2^-16."""
LOG1P_EXP = _table(lambda x: math.log1p(math.exp(-x)), 16.0)
"""Table of log(1 + exp(-x)) on [0, 16], in 2^-16."""
NORMAL = _table(lambda x: 0.5 * (1.0 + math.erf(x / math.sqrt(2.0))), 8.0)
"""Table of the cumulative normal distribution on [0, 8], in 2^-16."""


def look_up(table: NDArray[np.uint16], x: Fixed, step: int) -> Fixed:
    """Interpolate a table at x >= 0 with spacing `2^step`; beyond its end the last entries are used."""
    # The last entry has no neighbour to interpolate to; x stays just below it.
    x = np.minimum(x, ((TABLE - 1) << step) - 1)
    at, rest = x >> step, x & ((1 << step) - 1)
    low = table[at].astype(np.int64)
    high = table[at + 1].astype(np.int64)
    result: Fixed = low + round_shift((high - low) * rest, step)
    return result


def tanh(x: Fixed, frac: int) -> Fixed:
    """Return tanh in 2^-15, of x in ``2^-frac``, `frac` at least 6."""
    size = look_up(TANH, np.abs(x), frac - 6)
    result: Fixed = np.where(x < 0, -1, 1) * np.minimum((size + 1) >> 1, LARGEST)
    return result


def sigmoid(x: Fixed) -> Fixed:
    """Return the sigmoid in 2^-15, of x in 2^-16: ``(1 + tanh(x / 2)) / 2``."""
    # A half of x: one bit less of the step, instead of a shift that would lose that bit.
    half = look_up(TANH, np.abs(x), GATE_FRAC - 5)
    return np.minimum(round_shift(65536 + np.where(x < 0, -1, 1) * half, 2), LARGEST)


def exp(x: Fixed) -> Fixed:
    """Return exp in 2^-16, of x <= 0 in 2^-16."""
    return look_up(EXP, -x, GATE_FRAC - 5)


def softplus(x: Fixed) -> Fixed:
    """Return softplus in 2^-16, of x in 2^-16."""
    return np.maximum(x, 0) + look_up(LOG1P_EXP, np.abs(x), GATE_FRAC - 5)


def normal(x: Fixed) -> Fixed:
    """Return the cumulated normal distribution in 2^-16, of x in 2^-16."""
    above = look_up(NORMAL, np.abs(x), GATE_FRAC - 6)
    return np.where(x < 0, 65536 - above, above)


def softmax(scores: Fixed) -> Fixed:
    # Differences to the largest score are never positive, which is the half that the table covers.
    """Return the weights in 2^-15 over the last axis, of scores in 2^-16."""
    raised = exp(scores - scores.max(axis=-1, keepdims=True))
    total = raised.sum(axis=-1, keepdims=True)
    # Half of the divisor is added first, so that the quotient is rounded and not cut.
    return np.asarray(((raised << 15) + (total >> 1)) // total)
