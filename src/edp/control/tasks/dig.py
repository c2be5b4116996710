"""Digging cycle in soil: lower, penetrate, drag, curl and lift, reach out, dump."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edp.control.geometry import TipGeometry
from edp.control.reference import TipReference
from edp.control.tasks.base import TASKS, TaskSpec, check_order
from edp.settings.bounds import above, check_bounds

ENTRY_DEG, CLOSING_DEG, CURLED_DEG, OPEN_DEG = (-120.0, -95.0), (20.0, 45.0), (-200.0, -185.0), (-120.0, -80.0)
"""Bucket attitude at entry, rotation while dragging, closed and dumping attitude, deg. Straight down is -90 deg."""
ABOVE_M, LIFT_M, DUMP_M = 0.4, (1.2, 2.0), (2.0, 3.0)
"""Heights above the ground, m: tip before penetration, bucket pin after lifting, bucket pin while dumping."""
ENTRY_REACH, DUMP_REACH = (0.55, 0.8), (0.5, 0.7)
"""Distances from the boom foot as fractions of the reach: tip at entry, and bucket pin while dumping."""


@TASKS.register("dig")
@dataclass(frozen=True, kw_only=True)
class DigCycle(TaskSpec):
    """Legs of a digging cycle over level ground, as `edp.sim.excitation.dig` does them, without raising in a stall.

    Attributes:
        depth_m: least and largest depth of the drag.
        length_m: shortest and longest drag.
    """

    material: str = "sandy_loam"
    depth_m: tuple[float, float] = (0.05, 0.12)
    length_m: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds("task 'dig'", self, depth_m=above(0.0, 5.0), length_m=above(0.0, 50.0))
        check_order("task 'dig'", depth_m=self.depth_m, length_m=self.length_m)

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return the poses of a cycle with a random dragging depth below level ground."""
        ground, reach = geometry.ground_m, geometry.reach_m
        x, depth = rng.uniform(*ENTRY_REACH) * reach, rng.uniform(*self.depth_m)
        end = x - rng.uniform(*self.length_m)
        entry, closing, curled, opened = (
            math.radians(rng.uniform(*bounds)) for bounds in (ENTRY_DEG, CLOSING_DEG, CURLED_DEG, OPEN_DEG)
        )
        bucket = geometry.machine.bodies.length[2]
        # From the end of the drag on the pin is led: the bucket turns about it.
        pin = end - bucket * math.cos(entry - closing)
        dump, lifted, height = rng.uniform(*DUMP_REACH) * reach, rng.uniform(*LIFT_M), rng.uniform(*DUMP_M)
        points = np.array(
            [
                [x, ground + ABOVE_M, entry],
                [x, ground - depth, entry],
                [end, ground - depth, entry - closing],
                _tip_of(pin, ground + lifted, curled, bucket),
                _tip_of(dump, ground + height, curled, bucket),
                _tip_of(dump, ground + height, opened, bucket),
            ]
        )
        return self.tip_reference(name, points, self.draw_speed(rng), geometry, rate_hz)


def _tip_of(x: float, y: float, attitude: float, bucket: float) -> list[float]:
    """Return the tip pose whose bucket pin is at x, y (m)."""
    return [x + bucket * math.cos(attitude), y + bucket * math.sin(attitude), attitude]
