"""What sensors do to a signal: one pure function an effect, a size of zero changes nothing.

Signals have the shape ``(time, channel)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]


def quantised(values: Array, quantum: float) -> Array:
    """The nearest multiples of `quantum`."""
    return np.asarray(np.round(values / quantum) * quantum) if quantum > 0.0 else values


def random_walk(shape: tuple[int, int], step_s: float, size: float, rng: np.random.Generator) -> Array:
    """A bias that starts at zero and grows with the root of time: rms `size` after one second."""
    steps = rng.normal(0.0, size * np.sqrt(step_s), shape)
    steps[0] = 0.0
    return np.asarray(np.cumsum(steps, axis=0))


def lagged(values: Array, time_constant_s: float, step_s: float) -> Array:
    """First-order lag, exact for a signal that is linear between samples; at rest at the first value."""
    if time_constant_s <= 0.0:
        return values
    kept = np.exp(-step_s / time_constant_s)
    new = 1.0 - time_constant_s * (1.0 - kept) / step_s
    return np.asarray(values[:1] + signal.lfilter([new, 1.0 - kept - new], [1.0, -kept], values - values[:1], axis=0))


def limited(values: Array, full_scale: float) -> Array:
    """Cut to what a transmitter can show, 0 to `full_scale`."""
    return np.clip(values, 0.0, full_scale) if full_scale > 0.0 else values


def seats(force: Array, threshold: Array) -> Array:
    """The side on which each pin lies in its bore, +1 pushed out or -1 pulled in, shape ``(time, cylinder)``.

    It changes only once the force exceeds `threshold`, shape ``(cylinder,)``, in the other direction.
    """
    clear = np.where(np.abs(force) > threshold, np.sign(force), 0.0)
    clear[0] = np.where(force[0] < 0.0, -1.0, 1.0)
    since = np.maximum.accumulate(np.where(clear != 0.0, np.arange(len(force))[:, None], 0), axis=0)
    return np.take_along_axis(clear, since, axis=0)


def slack(seated: Array, width: Array, crossing_s: float, step_s: float) -> Array:
    """Velocity of a joint against its cylinder in the play of the pins, in m/s, shape ``(time, cylinder)``.

    A pin that pushes lies ahead of its bore by half of `width`, shape ``(cylinder,)``, in m; it crosses the play with a
    first-order lag. The mean velocity since the sample before, so that its sum is the way within the play.
    """
    kept = np.exp(-step_s / crossing_s)
    aim = -0.5 * width * seated
    start = aim[:1]
    place = start + signal.lfilter([0.0, 1.0 - kept], [1.0, -kept], aim - start, axis=0)
    return np.asarray(np.diff(place, axis=0, prepend=place[:1]) / step_s)
