"""Data-sheet model of a machine for controllers: nominal lever commands and kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose, valve

Array = NDArray[np.float64]


class NominalMachine:
    """One machine as its maker describes it.

    Args:
        machine: the parameter set.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.kinematics = pose.Kinematics(*pack(machine))

    def commands(self, levers: Any) -> Array:
        """Return nominal pilot pressures (Pa) of lever positions: the last 12 channels of Table A.1, shape (..., 12).

        Args:
            levers: shape (..., 3).

        Raises:
            ConfigError: another shape.
        """
        positions = _triples(levers, "levers")
        out = np.empty((positions.size // at.AXES, 2 * at.SPOOLS))
        rows = np.ascontiguousarray(positions.reshape(-1, at.AXES))
        full, axes, plant = self.machine.valves.pilot_pressure, self.kinematics.axes, self.kinematics.plant
        valve.fill_pilots(rows, full, axes, plant, np.empty(at.SPOOLS), out)
        return out.reshape(*positions.shape[:-1], 2 * at.SPOOLS)

    def tip(self, strokes: Any) -> Array:
        """Return tip x, y (m from the boom foot) and attitude (rad) at strokes (m from closed), both of shape (..., 3).

        Raises:
            ConfigError: another shape.
        """
        return self.kinematics.poses(_triples(strokes, "strokes"))

    def strokes(self, poses: Any) -> Array:
        """Return the strokes (m from closed) that put the tip at poses, both of shape (..., 3); NaN where it cannot be.

        Raises:
            ConfigError: another shape.
        """
        return self.kinematics.strokes(_triples(poses, "poses"))


def _triples(values: Any, what: str) -> Array:
    array = np.array(values, dtype=float)
    if array.ndim == 0 or array.shape[-1] != at.AXES:
        raise ConfigError(f"{what} of shape {array.shape}; the last axis must have three values")
    return array
