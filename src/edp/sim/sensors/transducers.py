"""Sensor errors of a value; a size of zero has no effect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]


@inlined
def quantised(value: float, quantum: float) -> float:
    """Round to the nearest multiple of `quantum`."""
    return float(np.rint(value / quantum) * quantum) if quantum > 0.0 else value


@inlined
def limited(value: float, full_scale: float) -> float:
    """Limit to the range of a transmitter, 0 to `full_scale`."""
    return min(max(value, 0.0), full_scale) if full_scale > 0.0 else value


def random_walk(shape: tuple[int, int], step_s: float, size: float, rng: np.random.Generator) -> Array:
    """Return a bias that starts at zero and grows with the square root of time: rms `size` after one second."""
    steps = rng.normal(0.0, size * np.sqrt(step_s), shape)
    # The bias is zero when the recording begins.
    steps[0] = 0.0
    return np.asarray(np.cumsum(steps, axis=0))


def lag(time_constant_s: float, step_s: float) -> tuple[float, float, float]:
    """Return the first-order lag that is exact for a signal that is linear between samples.

    Returns:
        a, b and c of y[k] = a x[k] + s[k - 1] and s[k] = b x[k] + c y[k].
    """
    if time_constant_s <= 0.0:
        return 1.0, 0.0, 0.0
    decay = float(np.exp(-step_s / time_constant_s))
    new = 1.0 - time_constant_s * (1.0 - decay) / step_s
    return new, 1.0 - decay - new, decay
