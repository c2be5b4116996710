"""What sensors do to a signal: one pure function an effect, a size of zero changes nothing.

Signals have the shape ``(time, channel)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.sensors import filters

Array = NDArray[np.float64]


def quantised(values: Array, quantum: float) -> Array:
    """The nearest multiples of `quantum`."""
    return np.asarray(np.round(values / quantum) * quantum) if quantum > 0.0 else values


def random_walk(shape: tuple[int, int], step_s: float, size: float, rng: np.random.Generator) -> Array:
    """A bias that starts at zero and grows with the root of time: rms `size` after one second."""
    steps = rng.normal(0.0, size * np.sqrt(step_s), shape)
    # The bias is zero when the recording begins.
    steps[0] = 0.0
    return np.asarray(np.cumsum(steps, axis=0))


def lagged(values: Array, time_constant_s: float, step_s: float) -> Array:
    """First-order lag, exact for a signal that is linear between samples; at rest at the first value."""
    if time_constant_s <= 0.0:
        return values
    decay = np.exp(-step_s / time_constant_s)
    new = 1.0 - time_constant_s * (1.0 - decay) / step_s
    return values[:1] + filters.lfilter([new, 1.0 - decay - new], [1.0, -decay], values - values[:1])


def limited(values: Array, full_scale: float) -> Array:
    """Cut to what a transmitter can show, 0 to `full_scale`."""
    return np.clip(values, 0.0, full_scale) if full_scale > 0.0 else values
