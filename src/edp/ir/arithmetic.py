"""Arithmetic of float layers: exact, or bit for bit as in the C runtime."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import Arithmetic, Values
from edp.ir.layers import LEAST, BinaryOperation, Function

Rows = NDArray[np.float32]
ONE = np.float32(1.0)


@dataclass(frozen=True, eq=False)
class FloatArithmetic(Arithmetic):
    """Arithmetic given by its functions.

    Attributes:
        functions: functions by name.
        operations: operations by name.
        in_order: whether sums are taken one after the other, as a loop in C does; NumPy's own sum adds in pairs.
    """

    functions: Mapping[str, Callable[[Values], Values]]
    operations: Mapping[str, Callable[[Values, Values], Values]]
    in_order: bool

    def apply(self, function: str, x: Values) -> Values:
        """See `Arithmetic`."""
        return self.functions[function](x)

    def combine(self, operation: str, a: Values, b: Values) -> Values:
        """See `Arithmetic`."""
        return self.operations[operation](a, b)

    def total(self, x: Values, axis: int = -1) -> Values:
        """See `Arithmetic`."""
        if not self.in_order:
            return np.asarray(x.sum(axis=axis))
        return np.asarray(np.take(np.add.accumulate(x, axis=axis, dtype=np.float32), -1, axis=axis))


# ---- exact -----------------------------------------------------------------------------------------------------------


def _sigmoid(x: Values) -> Values:
    # exp of a negative number cannot overflow; the two branches are the same function.
    small = np.exp(-np.abs(x))
    return np.where(x >= 0, 1 / (1 + small), small / (1 + small))


def _gelu(x: Values) -> Values:
    # NumPy has no error function; `math.erf` is exact to double precision.
    erf = np.array([math.erf(float(v) / math.sqrt(2)) for v in x.ravel()], dtype=x.dtype).reshape(x.shape)
    return np.asarray(x * (1 + erf) / 2)


EXACT = FloatArithmetic(
    {
        Function.RELU: lambda x: np.maximum(x, 0),
        Function.SIGMOID: _sigmoid,
        Function.TANH: np.tanh,
        Function.GELU: _gelu,
        # `logaddexp` neither overflows for large x nor loses digits for small ones.
        Function.SOFTPLUS: lambda x: np.logaddexp(x, np.zeros_like(x)),
        Function.EXP: np.exp,
        Function.SQRT: np.sqrt,
        Function.SINE: np.sin,
        Function.COSINE: np.cos,
        Function.LOG: lambda x: np.log(np.maximum(x, x.dtype.type(LEAST))),
        Function.POSITIVE: lambda x: np.asarray(x > 0, dtype=x.dtype),
    },
    {
        BinaryOperation.ADD: np.add,
        BinaryOperation.SUBTRACT: np.subtract,
        BinaryOperation.MULTIPLY: np.multiply,
        BinaryOperation.DIVIDE: np.divide,
        BinaryOperation.MINIMUM: np.minimum,
        BinaryOperation.MAXIMUM: np.maximum,
    },
    in_order=False,
)
"""NumPy functions in double or single precision, used as the exact reference."""


# ---- the C runtime's -------------------------------------------------------------------------------------------------


def _small_expm1(r: Rows) -> Rows:
    f = np.float32
    # Taylor's series to the seventh power: enough for float32 up to ln 2 / 2, and for the 0.34 of tanh.
    tail = f(1 / 6) + r * (f(1 / 24) + r * (f(1 / 120) + r * (f(1 / 720) + r * f(1 / 5040))))
    return np.asarray(r + r * r * (f(0.5) + r * tail))


def runtime_exp(x: Rows) -> Rows:
    """Return ``edp_exp`` of the runtime."""
    f = np.float32
    # Limits of float32: beyond them exp is 0 or infinite, and the shift below would leave the exponent's bits.
    limited = np.clip(x, f(-87.0), f(88.0))
    turns = limited * f(1.44269504)
    n = np.trunc(np.where(turns >= 0, turns + f(0.5), turns - f(0.5))).astype(np.int32)
    # ln 2 in two parts (Cody and Waite): n times the first part is exact, so the rest keeps its digits.
    r = (limited - n.astype(f) * f(0.693359375)) - n.astype(f) * f(-2.12194440e-4)
    # 2^n is written into the exponent's bits: exact, and cheaper than a power.
    power = ((n + 127).astype(np.uint32) << np.uint32(23)).view(np.float32)
    return np.asarray((ONE + _small_expm1(r)) * power)


def runtime_tanh(x: Rows) -> Rows:
    """Return ``edp_tanh`` of the runtime."""
    f = np.float32
    size = np.abs(x)
    # Near zero 1 - 2/(e+1) would cancel; the quotient of expm1 keeps relative accuracy.
    e = _small_expm1(f(2.0) * np.minimum(size, f(0.17)))
    near = e / (e + f(2.0))
    far = ONE - f(2.0) / (runtime_exp(f(2.0) * np.minimum(size, f(10.0))) + ONE)
    y = np.where(size < f(0.17), near, np.where(size < f(10.0), far, ONE))
    return np.asarray(np.where(x < 0, -y, y))


def runtime_sigmoid(x: Rows) -> Rows:
    """Return ``edp_sigmoid`` of the runtime."""
    small = runtime_exp(-np.abs(x))
    return np.asarray(np.where(x >= 0, ONE, small) / (ONE + small))


def runtime_log1p(x: Rows) -> Rows:
    """Return the log(1 + x) as the runtime has it, for x in [0, 1]."""
    f = np.float32
    s = x / (f(2.0) + x)
    # The series of artanh: log(1+x) = 2 artanh(x / (2 + x)), whose argument stays below 1/3.
    q = s * s
    tail = f(1 / 11) + q * (f(1 / 13) + q * f(1 / 15))
    tail = f(1 / 3) + q * (f(1 / 5) + q * (f(1 / 7) + q * (f(1 / 9) + q * tail)))
    return np.asarray(f(2.0) * (s + s * q * tail))


def _runtime_log(x: Rows) -> Rows:
    """Return ``natural_log`` of the runtime."""
    f = np.float32
    half, power = np.frexp(np.clip(x, f(LEAST), np.finfo(f).max))
    # Between 0.71 and 1.41 the logarithm of a number near 1 keeps its digits.
    above = half > f(0.707106769)
    mantissa, n = np.where(above, half, f(2.0) * half), (power - 1 + above).astype(f)
    y = n * f(0.693359375) + (n * f(-2.12194440e-4) + runtime_log1p(mantissa - ONE))
    return np.asarray(np.where(np.isnan(x), x, y))


def _runtime_softplus(x: Rows) -> Rows:
    return np.asarray(np.where(x > 0, x, np.float32(0)) + runtime_log1p(runtime_exp(-np.abs(x))))


def _runtime_gelu(x: Rows) -> Rows:
    erf = np.vectorize(math.erf, otypes=[np.float32])(x * np.float32(0.707106781))
    return np.asarray(np.float32(0.5) * x * (ONE + erf))


def _turned(x: Rows, quarters: int) -> Rows:
    """Return the runtime's sine of x plus a number of quarter turns."""
    f = np.float32
    # 8,192 rad: up to there n times the parts of pi/2 below stays exact.
    limited = np.clip(x, f(-8192.0), f(8192.0))
    turns = limited * f(0.636619772)
    n = np.trunc(np.where(turns >= 0, turns + f(0.5), turns - f(0.5))).astype(np.int32)
    whole = n.astype(f)
    # pi/2 in three parts (Cody and Waite), for the digits of large angles.
    r = ((limited - whole * f(1.5703125)) - whole * f(4.83751297e-4)) - whole * f(7.54978995e-8)
    q = r * r
    sine = r + r * q * (f(-1 / 6) + q * (f(1 / 120) + q * (f(-1 / 5040) + q * f(1 / 362880))))
    tail = f(1 / 24) + q * (f(-1 / 720) + q * (f(1 / 40320) + q * f(-1 / 3628800)))
    cosine = ONE + q * (f(-0.5) + q * tail)
    quarter = (n + quarters) & 3
    y = np.where(quarter & 1, cosine, sine)
    return np.asarray(np.where(quarter >= 2, -y, y))


RUNTIME = FloatArithmetic(
    {
        Function.RELU: lambda x: np.where(x > 0, x, np.float32(0)),
        Function.SIGMOID: runtime_sigmoid,
        Function.TANH: runtime_tanh,
        Function.GELU: _runtime_gelu,
        Function.SOFTPLUS: _runtime_softplus,
        Function.EXP: runtime_exp,
        Function.SQRT: np.sqrt,
        Function.SINE: lambda x: _turned(x, 0),
        Function.COSINE: lambda x: _turned(x, 1),
        Function.LOG: _runtime_log,
        Function.POSITIVE: lambda x: (x > 0).astype(np.float32),
    },
    {
        BinaryOperation.ADD: np.add,
        BinaryOperation.SUBTRACT: np.subtract,
        BinaryOperation.MULTIPLY: np.multiply,
        BinaryOperation.DIVIDE: np.divide,
        # As in C, where a comparison with NaN is false: the first number stays.
        BinaryOperation.MINIMUM: lambda a, b: np.where(a > b, b, a),
        BinaryOperation.MAXIMUM: lambda a, b: np.where(a < b, b, a),
    },
    in_order=True,
)
"""Arithmetic in single precision with the functions and summation order of the C runtime."""
