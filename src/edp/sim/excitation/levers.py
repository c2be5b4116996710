"""Lever characteristics of a machine: ends of the dead bands, and the lever for a cylinder speed."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics.plant import Plant

Array = NDArray[np.float64]
AXES = 3
LEVERS = (0.25, 0.35, 0.5, 0.7, 1.0)
"""Lever positions for the measurement of the speed curves. They are closer near the dead band, where the curve bends
most."""
RUN_S, SETTLE_S = 0.9, 0.5
"""Duration of the test of each lever position (s), and the initial part (s) that is not evaluated because valve and
pump settle."""


def dead_lever(machine: Machine) -> Array:
    """Return the lever positions at which the main spools begin to open, shape (3, 2): extend, retract."""
    valves = machine.valves
    bands = np.array([valves.dead_band_extend, valves.dead_band_retract]).T
    shaped: Array = valves.lever_dead_zone + (1.0 - valves.lever_dead_zone) * bands
    return shaped


# Thirty short simulations each; few are kept, since a family may have a thousand machines.
@lru_cache(maxsize=8)
def speed_table(machine: Machine) -> tuple[Array, Array]:
    """Return the lever to cylinder speed, measured on the machine from mid stroke in free air.

    As an automatic control is set up.

    Returns:
        Levers, shape (3, 2, levers), and the speeds (m/s, positive in either direction), the same shape; the first
        lever is the end of the dead band, with speed zero.
    """
    dead = dead_lever(machine)
    levers = np.zeros((AXES, 2, len(LEVERS) + 1))
    speeds = np.zeros_like(levers)
    for axis in range(AXES):
        for side, sign in enumerate((1.0, -1.0)):
            levers[axis, side, 0] = dead[axis, side]
            for n, lever in enumerate(LEVERS, start=1):
                # Levers must rise along the table even where the dead band is wide.
                levers[axis, side, n] = max(lever, dead[axis, side] + 0.02 * n)
                targets = np.zeros((round(RUN_S * 100), AXES))
                targets[:, axis] = sign * levers[axis, side, n]
                # Begun on the far side of mid stroke, so that no run meets an end.
                plant = Plant(machine, np.full(AXES, 0.5 - 0.15 * sign))
                log = plant.run(targets)[round(SETTLE_S * 100) :]
                speed = sign * float(log[:, at.LOG_VELOCITY + axis].mean())
                # a heavy boom may sink before it rises: speeds never fall with the lever
                speeds[axis, side, n] = max(speed, speeds[axis, side, n - 1] + 1e-3)
    return levers, speeds
