"""Grading: a straight line of the tip at constant attitude, flat or on a slope."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edp.control.geometry import TipGeometry
from edp.control.reference import TipReference
from edp.control.tasks.base import TASKS, TaskSpec, check_order
from edp.errors import ConfigError, closest
from edp.settings.bounds import above, check_bounds, span

DIRECTIONS = ("random", "inwards", "outwards")
SOIL_ATTITUDE_DEG = (-100.0, -55.0)
"""In which the edge of a bucket cuts and neither its back nor its floor is dragged through the soil."""
START = (0.1, 0.9)
"""Strokes (shares) of which the start is drawn."""


@TASKS.register("grade")
@dataclass(frozen=True, kw_only=True)
class Grade(TaskSpec):
    """A line at constant attitude, anywhere in reach; in soil at the surface.

    Attributes:
        slope_deg: rise of the line away from the machine.
        length_m: shortest and longest line.
        direction: ``inwards``, ``outwards`` or ``drawn``.
        attitude_deg: least and largest attitude; None: that of the strokes drawn, in soil `SOIL_ATTITUDE_DEG`.
        depth_m: in a material, range of the depth of the line's start below level ground, m.
    """

    slope_deg: float = 0.0
    length_m: tuple[float, float] = (1.5, 3.0)
    direction: str = "random"
    attitude_deg: tuple[float, float] | None = None
    depth_m: tuple[float, float] = (0.0, 0.05)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(
            "task 'grade'", self, slope_deg=span(-80.0, 80.0), length_m=above(0.0, 100.0), depth_m=span(-5.0, 5.0)
        )
        if self.attitude_deg is not None:
            check_bounds("task 'grade'", self, attitude_deg=span(-270.0, 90.0))
            check_order("task 'grade'", attitude_deg=self.attitude_deg)
        check_order("task 'grade'", length_m=self.length_m, depth_m=self.depth_m)
        if self.direction not in DIRECTIONS:
            raise ConfigError(f"task 'grade': direction = '{self.direction}'{closest(self.direction, DIRECTIONS)}")

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return a line from a random pose."""
        start = geometry.tip(rng.uniform(*START, 3) * geometry.full_m)
        attitudes = self.attitude_deg or (SOIL_ATTITUDE_DEG if self.material else None)
        if attitudes:
            start[2] = math.radians(rng.uniform(*attitudes))
        if self.material:
            # A line anywhere in reach would mostly lie metres under ground.
            start[1] = geometry.ground_m - rng.uniform(*self.depth_m)
        length, speed = rng.uniform(*self.length_m), self.draw_speed(rng)
        # In soil the bucket cuts inwards; outwards it would be pushed through it by its back.
        away = rng.random() < 0.5 and not self.material
        outwards = away if self.direction == "random" else self.direction == "outwards"
        slope = math.radians(self.slope_deg)
        along = length if outwards else -length
        goal = start + along * np.array([math.cos(slope), math.sin(slope), 0.0])
        return self.tip_reference(name, np.array([start, goal]), speed, geometry, rate_hz)
