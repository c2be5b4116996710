"""Causal linear filters along time, compiled: importing SciPy's filters would take longer than most simulations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import compiled, inlined

Array = NDArray[np.float64]
DERIVATIVE_DAMPING = 0.7
"""Damping ratio of the derivative filter: nearly flat up to the bandwidth, with little overshoot of the acceleration.
"""


@inlined
def biquad(x: float, numbers: Array, state: Array) -> float:
    """Return one sample of a filter of order two with a[0] = 1, transposed direct form II.

    `numbers` contains b[0], b[1], b[2], a[1], a[2]; `state` (two values) is updated.
    """
    y: float = numbers[0] * x + state[0]
    state[0] = numbers[1] * x - numbers[3] * y + state[1]
    state[1] = numbers[2] * x - numbers[4] * y
    return y


@compiled
def _filter(numbers: Array, values: Array, state: Array, out: Array) -> None:
    for channel in range(values.shape[1]):
        state[0] = state[1] = 0.0
        for k in range(values.shape[0]):
            out[k, channel] = biquad(values[k, channel], numbers, state)


def lfilter(numbers: Array, values: Array) -> Array:
    """Apply the filter of `biquad` along time from a zero state, shape ``(time, channel)``."""
    out = np.empty(values.shape)
    _filter(numbers, np.ascontiguousarray(values, dtype=float), np.zeros(2), out)
    return out


def derivative_numbers(bandwidth_hz: float, rate_hz: float) -> Array:
    """Return w^2 s / (s^2 + 2 zeta w s + w^2) discretised by the bilinear rule for `biquad`, shape (5,)."""
    # Below half of the rate, where the bilinear rule warps frequencies.
    omega = 2.0 * math.pi * min(bandwidth_hz, 0.4 * rate_hz)
    k = 2.0 * rate_hz
    scale = k * k + 2.0 * DERIVATIVE_DAMPING * omega * k + omega * omega
    gain = omega * omega * k / scale
    middle = 2.0 * (omega * omega - k * k) / scale
    return np.array([gain, 0.0, -gain, middle, (k * k - 2.0 * DERIVATIVE_DAMPING * omega * k + omega * omega) / scale])


def filtered_derivative(values: Array, bandwidth_hz: float, rate_hz: float) -> Array:
    """Return the causal derivative along time by the filter of `derivative_numbers`, shape ``(time, channel)``.

    The filter starts in steady state at the first value.
    """
    return lfilter(derivative_numbers(bandwidth_hz, rate_hz), values - values[:1])
