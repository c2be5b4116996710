"""Path with corners: straight segments of the tip at constant attitude, with a stop at each corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.control.geometry import TipGeometry
from edp.control.reference import TipReference
from edp.control.tasks.base import TASKS, TaskSpec
from edp.control.tasks.grade import START
from edp.settings.bounds import above, check_bounds, integer


@TASKS.register("corners")
@dataclass(frozen=True, kw_only=True)
class CornerPath(TaskSpec):
    """A rectangle's corners one after another: along, up, back, down; cut after some legs.

    Attributes:
        width_m: range of the rectangle's width, m.
        height_m: range of the rectangle's height, m.
        legs: number of its sides that are run.
    """

    width_m: float = 1.2
    height_m: float = 0.8
    legs: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = above(0.0, 100.0)
        check_bounds("task 'corners'", self, width_m=positive, height_m=positive, legs=integer(1, 4))

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return a rectangle from a random pose, towards or away from the machine, upwards or downwards."""
        start = geometry.tip(rng.uniform(*START, 3) * geometry.full_m)
        along, up = rng.choice([-1.0, 1.0], 2) * (self.width_m, self.height_m)
        steps = np.array([[along, 0.0, 0.0], [0.0, up, 0.0], [-along, 0.0, 0.0], [0.0, -up, 0.0]])[: self.legs]
        points = start + np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))
        return self.tip_reference(name, points, self.draw_speed(rng), geometry, rate_hz)
