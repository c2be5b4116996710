"""Causal linear filters along time, compiled: importing SciPy's would take longer than most simulations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]


@compiled
def _filter(b: Array, a: Array, values: Array, out: Array) -> None:
    """Transposed direct form II with up to two states per channel."""
    for channel in range(values.shape[1]):
        first = second = 0.0
        for k in range(values.shape[0]):
            x = values[k, channel]
            y = b[0] * x + first
            first = b[1] * x - a[1] * y + second
            second = b[2] * x - a[2] * y
            out[k, channel] = y


def lfilter(b: list[float], a: list[float], values: Array) -> Array:
    """Filter of order one or two with a[0] = 1, from rest, shape ``(time, channel)``."""
    out = np.empty(values.shape)
    # Padded to order two, so that one compiled function serves both orders.
    numerator, denominator = (np.array([*c, 0.0, 0.0][:3]) for c in (b, a))
    _filter(numerator, denominator, np.ascontiguousarray(values, dtype=float), out)
    return out


def bilinear_derivative(omega: float, damping: float, rate_hz: float) -> tuple[list[float], list[float]]:
    """Coefficients of w^2 s / (s^2 + 2 zeta w s + w^2) by the bilinear rule: numerator and denominator."""
    k = 2.0 * rate_hz
    scale = k * k + 2.0 * damping * omega * k + omega * omega
    gain = omega * omega * k / scale
    middle = 2.0 * (omega * omega - k * k) / scale
    return [gain, 0.0, -gain], [1.0, middle, (k * k - 2.0 * damping * omega * k + omega * omega) / scale]
