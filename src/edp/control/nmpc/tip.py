"""Tip poses and their slopes by the strokes, for whole horizons at once: tables of the joint angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES, TipGeometry
from edp.control.nmpc.compiled import fill_poses
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose

Array = NDArray[np.float64]
NODES = 4001
"""Number of nodes of the table. Linear interpolation errors are a few micrometres; strokes are measured to 0.1 mm."""


class TipTable:
    """Poses of the bucket tip and their Jacobians by the strokes, from tables of the joint angles.

    Args:
        geometry: geometry of the machine.

    Attributes:
        full_m: full stroke of each cylinder, shape (3,), m.
    """

    def __init__(self, geometry: TipGeometry) -> None:
        machine: Machine = geometry.machine
        axes, plant = pack(machine)
        kinematics = pose.Kinematics(axes, plant)
        shares = np.linspace(0.0, 1.0, NODES)
        self.full_m: Array = np.array(geometry.full_m, float)
        self._angles: Array = np.array([kinematics.angles_at(np.full(AXES, share)) for share in shares])
        self._lengths = np.array(machine.bodies.length, float)

    @property
    def angles(self) -> Array:
        """Joint angles (rad) at the nodes, each relative to the link before, shape (nodes, 3)."""
        return self._angles

    def poses(self, strokes: Array) -> tuple[Array, Array]:
        """Return the poses and Jacobians.

        Args:
            strokes: m, shape (..., 3); those beyond an end stop count as at the stop.

        Returns:
            Tip x, y (m) and attitude (rad), shape (..., 3), and their derivatives by the strokes (m/m, m/m, rad/m),
            shape (..., 3, 3).
        """
        rows = np.ascontiguousarray(strokes, dtype=float).reshape(-1, AXES)
        tips, jacobians = np.empty((len(rows), 3)), np.empty((len(rows), 3, AXES))
        fill_poses(rows, self._angles, self.full_m, self._lengths, tips, jacobians)
        shape = strokes.shape[:-1]
        return tips.reshape(*shape, 3), jacobians.reshape(*shape, 3, AXES)
