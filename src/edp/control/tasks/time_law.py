"""Time law of a path: speed along the path over time, without steps in speed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.registry import Registry

Array = NDArray[np.float64]

LAWS: Registry[Callable[[Array], Array]] = Registry("time law")
"""Registry of the time laws of a ramp: completed fraction of the ramp's length, shape (...), as a function of the
elapsed fraction of its duration. Values go from 0 to 0.5, since the mean speed of a ramp is half.
"""


@LAWS.register("trapezoid")
def trapezoid(share: Array) -> Array:
    """Speed that rises in a straight line: constant acceleration."""
    return np.asarray(0.5 * share**2)


@LAWS.register("s_curve")
def s_curve(share: Array) -> Array:
    """Speed that rises as 3 q^2 - 2 q^3: continuous acceleration, 1.5 times as high in the middle."""
    return np.asarray(share**3 - 0.5 * share**4)


def progress(time_s: Array, length_s: float, ramp_s: float, law: str) -> Array:
    """Share of the way done, 0 to 1, with a ramp at either end.

    Args:
        time_s: time since the start in s, any shape.
        length_s: duration of the whole path, s.
        ramp_s: time to speed up, and to slow down, s; at most half of `length_s`.
        law: name in `LAWS`.
    """
    ramp = min(ramp_s, 0.5 * length_s)
    time = np.clip(time_s, 0.0, length_s)
    before_end = length_s - time
    rise, fall = (LAWS[law](np.clip(t / ramp, 0.0, 1.0)) * ramp for t in (time, before_end))
    middle = time - 0.5 * ramp
    done = np.where(time < ramp, rise, np.where(before_end < ramp, length_s - ramp - fall, middle))
    return np.asarray(done / (length_s - ramp))


def duration_s(length: float, speed: float, ramp_s: float) -> float:
    """Return the seconds of a way at a top speed with a ramp at either end; short ways are ramps only, and slower."""
    return max(length / speed + ramp_s, 2.0 * ramp_s)


def timed(
    points: Array, seconds: Sequence[float], rate_hz: float, ramp_s: float, law: str, lead_s: float, hold_s: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return rows along straight segments with a stop at each point, with waiting times before and after.

    Args:
        points: shape (legs + 1, values).
        seconds: length of each leg.
        rate_hz: sampling rate in Hz.
        ramp_s: see `progress`.
        law: time law, see `progress`.
        lead_s: rest at the first point, not evaluated.
        hold_s: rest at the last one, evaluated.

    Returns:
        Rows, shape (ticks, values), and which of them are evaluated, shape (ticks,).
    """
    ends = lead_s + np.concatenate(([0.0], np.cumsum(seconds)))
    ticks = round((ends[-1] + hold_s) * rate_hz) + 1
    time = np.arange(ticks) / rate_hz
    rows = np.repeat(points[:1], ticks, axis=0)
    for start, end, begin, goal in zip(ends[:-1], ends[1:], points[:-1], points[1:], strict=True):
        rows += progress(time - start, end - start, ramp_s, law)[:, None] * (goal - begin)
    return rows, time >= lead_s
