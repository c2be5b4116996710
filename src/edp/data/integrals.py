"""Whether measured strokes are the integrals of measured velocities, as units and scales that are right make them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.wording import typed

WINDOW_S = 1.0
"""Interval over which changes are compared, s. Sensor delays, velocity noise and drift are small over this interval."""
MIN_TICKS = 5
TOLD = 0.9
"""Minimum correlation between the integrated velocity and the stroke for a conclusion. A lower correlation can come
from noise, drift or another actuator."""
LOW, HIGH = 0.8, 1.25
"""Accepted range of the ratio. It allows for uncalibrated sensors and is too narrow for any wrong unit."""

Rows = NDArray[np.floating]


@dataclass(frozen=True)
class IntegralFit:
    """Fit between the changes of a stroke and the integral of its velocity.

    Attributes:
        ratio: root-mean-square change of the stroke over that of the integral; negative where they go against each
            other, 0 where one of them rests.
        correlation: correlation of the two changes about zero.
    """

    ratio: float
    correlation: float

    @property
    def contradicts(self) -> bool:
        """Return whether stroke and velocity are correlated but differ in scale or sign."""
        return abs(self.correlation) >= TOLD and not LOW <= self.ratio <= HIGH


def integral_fit(pairs: Sequence[tuple[Rows, Rows]], rate_hz: float) -> IntegralFit:
    """Compare a stroke with the integral of its velocity by the trapezoidal rule, over windows of `WINDOW_S`.

    Args:
        pairs: velocity and stroke of each segment ``(tick,)``, in consistent units.
        rate_hz: sample rate.
    """
    ticks = max(MIN_TICKS, round(WINDOW_S * rate_hz))
    of_stroke, of_velocity, both = 0.0, 0.0, 0.0
    for velocity, stroke in pairs:
        speed = velocity.astype(np.float64)
        way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) / rate_hz])
        moved = stroke[ticks:].astype(np.float64) - stroke[:-ticks]
        integrated = way[ticks:] - way[:-ticks]
        of_stroke += float(moved @ moved)
        of_velocity += float(integrated @ integrated)
        both += float(moved @ integrated)
    if not of_stroke or not of_velocity:
        return IntegralFit(0.0, 0.0)
    correlation = both / np.sqrt(of_stroke * of_velocity)
    return IntegralFit(float(np.copysign(np.sqrt(of_stroke / of_velocity), both)), float(correlation))


def contradiction(velocity: str, stroke: str, fit: IntegralFit) -> str:
    """Return the message for a fit that `contradicts`, with the remedy."""
    scale = typed(fit.ratio, 3)
    return (
        f"stroke '{stroke}' changes by {scale} times what velocity '{velocity}' adds up to (over {typed(WINDOW_S)} s, "
        f"correlation {fit.correlation:.2f}); {typed(LOW)} to {typed(HIGH)} must hold, since a stroke is the "
        "integral of its "
        f"velocity: correct the unit, the sign or the scale of one of them in the signal map (scale = {scale} for "
        f"'{velocity}', if it is the wrong one)"
    )
