"""Point to point: all three cylinders go from one pose to the next and stop there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.control.geometry import TipGeometry
from edp.control.reference import TipReference, reference_of_strokes
from edp.control.tasks.base import TASKS, TaskSpec
from edp.control.tasks.time_law import duration_s, timed
from edp.settings.bounds import check_bounds, integer

STEP = 0.4
"""Maximum distance between two points as a fraction of the stroke. A move takes a few seconds."""
POINTS = (0.15, 0.85)
"""Range of the random points, as fractions of the stroke."""


@TASKS.register("point")
@dataclass(frozen=True, kw_only=True)
class PointToPoint(TaskSpec):
    """Straight stroke motion between random points, with a stop at each.

    Attributes:
        points: number of points after the start.
    """

    points: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds("task 'point'", self, points=integer(1, 100))

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return random points, each within `STEP` of the previous one."""
        shares = [rng.uniform(*POINTS, 3)]
        for _ in range(self.points):
            shares.append(np.clip(shares[-1] + rng.uniform(-STEP, STEP, 3), *POINTS))
        points = np.array(shares) * geometry.full_m
        speed = self.draw_speed(rng)
        ways = np.hypot(*np.diff(geometry.tip(points)[:, :2], axis=0).T)
        seconds = [duration_s(float(way), speed, self.ramp_s) for way in ways]
        rows, judged = timed(points, seconds, rate_hz, self.ramp_s, self.law, self.lead_s, self.hold_s)
        return reference_of_strokes(name, rows, geometry, rate_hz, judged, self.margin)
