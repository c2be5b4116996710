"""The engine that turns the pumps: a governor with droop, and an inertia that loads slow down."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]
MIN_SPEED = 0.3
"""Minimum engine speed as a fraction of the governed speed. A diesel engine does not run at lower speeds, so the
simulated engine does not stall."""


@compiled
def load_power(row: Array, plant: Array) -> float:
    """Return the power (W) that both pumps take from the shaft at a logged sample and the present speed."""
    power = 0.0
    for m in range(2):
        power += plant[at.MAX_FLOW] * row[at.DISPLACEMENT + m] * max(row[at.PUMP + m], 0.0)
    return power


@compiled
def turn(row: Array, plant: Array, time_s: float) -> None:
    """Advance the speed by `time_s` under the load of a logged sample, and let the pumps' flow follow it.

    With n the share of the governed speed and E = J omega^2 at n = 1: d(E n^2 / 2)/dt = P_engine(n) - P_load, where
    P_engine is ``P (1 - n) / droop``, from 0 to the engine's power P. One implicit Euler step, which keeps this balance
    of energy exactly for the load at its beginning; without droop nothing changes.
    """
    droop = plant[at.ENGINE_DROOP]
    if droop <= 0.0:
        return
    speed, power = plant[at.ENGINE_SPEED], plant[at.ENGINE_POWER]
    per_watt = 2.0 * time_s / plant[at.ENGINE_ENERGY]
    left = speed * speed - per_watt * load_power(row, plant)
    # n'^2 + 2 b n' = c on the governor's line; its ends where the root lies beyond them.
    b = 0.5 * per_watt * power / droop
    c = left + 2.0 * b
    new = -b + math.sqrt(max(b * b + c, 0.0))
    if new > 1.0:
        new = math.sqrt(max(left, 0.0))
    elif new < 1.0 - droop:
        new = math.sqrt(max(left + per_watt * power, 0.0))
    plant[at.ENGINE_SPEED] = max(new, MIN_SPEED)
    plant[at.MAX_FLOW] = plant[at.RATED_FLOW] * plant[at.ENGINE_SPEED]
