"""Operator's view of the plant: the noise-free present, cheap enough for every control step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics import pose
from edp.sim.physics.plant import Plant

Array = NDArray[np.float64]


class View(NamedTuple):
    """The plant at one instant; frame and attitude as in `edp.sim.physics.pose`.

    Attributes:
        strokes: strokes as fractions of each cylinder's full stroke, shape (3,).
        angles: relative joint angles, rad, shape (3,).
        rates: their rates, rad/s, shape (3,).
        speeds: cylinder velocities, m/s, shape (3,).
        tip_x: bucket tip forward of the boom foot, m.
        tip_y: bucket tip above the boom foot, m.
        attitude: absolute angle of the bucket, rad.
        ground: height of the ground below the tip, m; NaN in free air.
        payload_kg: mass in the bucket.
        swing: angle of the upper structure from where it began, rad; 0 where it does not swing.
        swing_rate: its rate, rad/s.
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
    swing: float = 0.0
    swing_rate: float = 0.0

    @property
    def depth(self) -> float:
        """Tip below the ground, m; NaN in free air."""
        return self.ground - self.tip_y


def view_of(plant: Plant) -> View:
    """Return the present view of a plant."""
    look = np.empty(pose.LOOK_VALUES)
    pose.look_at(plant.state, plant.axes, plant.plant, look)
    x, y, attitude = look[pose.TIP :].tolist()
    ground = math.nan if plant.ground is None else plant.ground.height(x)
    swing = (0.0, 0.0) if plant.motors is None else plant.motors.swing
    return View(look[0:3], look[3:6], look[6:9], look[9:12], x, y, attitude, ground, plant.payload_kg, *swing)
