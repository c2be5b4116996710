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

DIRECTIONS = ("drawn", "inwards", "outwards")
START = (0.1, 0.9)
"""Strokes (shares) of which the start is drawn."""


@TASKS.register("grade")
@dataclass(frozen=True, kw_only=True)
class Grade(TaskSpec):
    """A line at constant attitude, anywhere in reach.

    Attributes:
        slope_deg: rise of the line away from the machine.
        length_m: shortest and longest line.
        direction: ``inwards``, ``outwards`` or ``drawn``.
    """

    slope_deg: float = 0.0
    length_m: tuple[float, float] = (1.5, 3.0)
    direction: str = "drawn"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds("task 'grade'", self, slope_deg=span(-80.0, 80.0), length_m=above(0.0, 100.0))
        check_order("task 'grade'", length_m=self.length_m)
        if self.direction not in DIRECTIONS:
            raise ConfigError(f"task 'grade': direction = '{self.direction}'{closest(self.direction, DIRECTIONS)}")

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """A line from a pose of drawn strokes."""
        start = geometry.tip(rng.uniform(*START, 3) * geometry.full_m)
        length, speed = rng.uniform(*self.length_m), self.drawn_speed(rng)
        outwards = rng.random() < 0.5 if self.direction == "drawn" else self.direction == "outwards"
        slope = math.radians(self.slope_deg)
        along = length if outwards else -length
        goal = start + along * np.array([math.cos(slope), math.sin(slope), 0.0])
        return self.tip_reference(name, np.array([start, goal]), speed, geometry, rate_hz)
