"""What an operator sees of the plant: the noise-free present, cheap enough to be taken at every control step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.sim import pose
from edp.sim.plant import Plant
from edp.sim.soil import Ground

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class View:
    """The plant at one instant; frame and attitude as in `edp.sim.pose`.

    Attributes:
        strokes: shares of each cylinder's stroke, shape (3,).
        angles: relative joint angles, rad, shape (3,).
        rates: their rates, rad/s, shape (3,).
        speeds: cylinder velocities, m/s, shape (3,).
        tip_x: bucket tip forward of the boom foot, m.
        tip_y: bucket tip above the boom foot, m.
        attitude: absolute angle of the bucket, rad.
        ground: height of the ground below the tip, m; NaN in free air.
        payload_kg: mass in the bucket.
    """

    strokes: Array
    angles: Array
    rates: Array
    speeds: Array
    tip_x: float
    tip_y: float
    attitude: float
    ground: float = math.nan
    payload_kg: float = 0.0

    @property
    def depth(self) -> float:
        """Tip below the ground, m; NaN in free air."""
        return self.ground - self.tip_y


def view_of(plant: Plant) -> View:
    """The present view of a plant."""
    look = np.empty(pose.LOOK_VALUES)
    pose.look_at(plant.state, plant.axes, plant.plant, look)
    x = float(look[pose.TIP])
    ground = math.nan if plant.ground is None else height_at(plant.ground, x)
    tip = float(look[pose.TIP + 1]), float(look[pose.TIP + 2])
    return View(look[0:3], look[3:6], look[6:9], look[9:12], x, *tip, ground, plant.payload_kg)


def height_at(ground: Ground, x: float) -> float:
    """`Ground.height`, without arrays."""
    heights = ground.heights
    place = min(max((x - ground.start_m) / ground.spacing_m, 0.0), len(heights) - 1.000001)
    k = int(place)
    left, right = float(heights[k]), float(heights[k + 1])
    return left + (place - k) * (right - left)
