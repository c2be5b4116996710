"""Kinematics of one front in SI units: from strokes to tip poses and back, row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose

Array = NDArray[np.float64]
AXES = 3


class TipGeometry:
    """Strokes in m to tip poses and back, for the boom, arm and bucket of one machine.

    The frame is that of `edp.sim.physics.pose`: origin in the boom foot, x forward, y up, attitude the absolute angle
    of the line from the bucket pin to the tip. It is measured on a machine with a tape, so controllers may know it.

    Attributes:
        machine: machine that the geometry describes.
        full_m: full stroke of each cylinder, shape (3,), m.
        reach_m: longest distance of the tip from the boom foot, m.
        ground_m: height of level ground in the frame of the tip, m.
    """

    def __init__(self, machine: Machine) -> None:
        axes, plant = pack(machine)
        self.machine = machine
        self.full_m: Array = np.array(machine.cylinders.stroke)
        self.reach_m = float(sum(machine.bodies.length))
        self.ground_m = -machine.chassis.boom_foot_height
        self._kinematics = pose.Kinematics(axes, plant)

    def tip(self, strokes_m: Array) -> Array:
        """Return the tip x and y (m) and attitude (rad) at strokes (m), shape (..., 3) both.

        Raises:
            ConfigError: a stroke that is not finite.
        """
        strokes = np.asarray(strokes_m, float)
        if not np.isfinite(strokes).all():
            raise ConfigError("a tip pose was asked for at a stroke that is not finite; give measured strokes in m")
        return self._kinematics.poses(np.clip(strokes, 0.0, self.full_m))

    def strokes(self, poses: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the strokes (m) that put the tip at poses, and which of the poses can be reached.

        Args:
            poses: tip x, y (m) and attitude (rad), shape (..., 3).

        Returns:
            Strokes of the shape of `poses`, NaN where a pose is out of reach; and whether each can be reached, (...).
        """
        strokes = self._kinematics.strokes(poses)
        return strokes, np.asarray(np.isfinite(strokes).all(axis=-1))
