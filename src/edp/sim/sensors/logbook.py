"""Logged sample: ground truth at an instant, in the columns of `edp.sim.machine.layout`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import lines, linkage, pump
from edp.sim.physics import motors as places
from edp.sim.physics.jit import compiled
from edp.sim.physics.motors import Motors
from edp.sim.physics.scratch import MovingParts

Array = NDArray[np.float64]


@compiled
def write_events(
    state: Array,
    valves: Array,
    axes: Array,
    plant: Array,
    memory: Array,
    row: Array,
    motors: Motors | None = None,
) -> None:
    """Write the flags 0 or 1: relief, cavitation, regeneration, power limit, soil contact."""
    relief = cavitation = regeneration = limited = 0.0
    port = lines.first_valve_pressure(plant)
    for i in range(at.AXES):
        head, rod, spool = state[port + i], state[port + at.AXES + i], valves[i, at.SPOOL]
        if head > axes[i, at.RELIEF_HEAD] or rod > axes[i, at.RELIEF_ROD]:
            relief = 1.0
        if head < 0.0 or rod < 0.0:
            cavitation = 1.0
        arm_in = axes[i, at.REGEN_EXTEND] > 0.0 and spool > axes[i, at.DEAD_BAND_EXTEND] and rod > head
        boom_down = axes[i, at.REGEN_RETRACT] > 0.0 and -spool > axes[i, at.DEAD_BAND_RETRACT] and head > rod
        if arm_in or boom_down:
            regeneration = 1.0
    for m in range(2):
        if state[at.PUMP + m] > plant[at.PUMP_RELIEF]:
            relief = 1.0
    if motors is not None and places.relieved(motors):
        relief = 1.0
    first, second = pump.asked(state, valves, axes, plant, motors)
    # Use the demand and not the displacement: the limit acts if the demanded power exceeds the available power.
    power = plant[at.MAX_FLOW] * (first * state[at.PUMP] + second * state[at.PUMP + 1])
    if power > plant[at.POWER_LIMIT]:
        limited = 1.0
    row[at.LOG_EVENTS + at.RELIEF] = relief
    row[at.LOG_EVENTS + at.CAVITATION] = cavitation
    row[at.LOG_EVENTS + at.REGENERATION] = regeneration
    row[at.LOG_EVENTS + at.POWER_LIMITED] = limited
    row[at.LOG_EVENTS + at.SOIL_CONTACT] = memory[at.TOUCHED]
    # Cleared at each sample: a touch between two samples is shown once.
    memory[at.TOUCHED] = 0.0


@compiled
def write_tip(state: Array, axes: Array, row: Array) -> None:
    """Write the bucket tip (m from the boom foot) and attitude (rad)."""
    x = y = angle = 0.0
    for i in range(at.AXES):
        angle += state[at.PSI + i]
        x += axes[i, at.LENGTH] * math.cos(angle)
        y += axes[i, at.LENGTH] * math.sin(angle)
    row[at.LOG_TIP], row[at.LOG_TIP + 1], row[at.LOG_TIP + 2] = x, y, angle


@compiled
def write_log(
    moving: MovingParts,
    demand: Array,
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    row: Array,
    motors: Motors | None = None,
) -> None:
    """Write one sample: plant state, demands, strokes (m from closed), velocities (m/s), and additional true values."""
    (state, valves), (axes, plant, _, ground) = moving, setup
    heights, memory = ground[3], ground[4]
    for n in range(at.LOGGED_STATES):
        row[n] = state[n]
    port = lines.first_valve_pressure(plant)
    for n in range(2 * at.AXES):
        row[at.LOG_PORT + n] = state[port + n]
    for j in range(at.SPOOLS):
        row[at.LOG_DEMAND + j] = demand[j]
        row[at.LOG_SPOOL + j] = valves[j, at.SPOOL]
    for i in range(at.AXES):
        length, lever = linkage.cylinder(i, state[at.PSI + i], plant)
        row[at.LOG_STROKE + i] = length - axes[i, at.CLOSED]
        row[at.LOG_VELOCITY + i] = lever * state[at.RATE + i]
    write_tip(state, axes, row)
    row[at.LOG_FORCE], row[at.LOG_FORCE + 1] = memory[at.FORCE_X], memory[at.FORCE_Y]
    row[at.LOG_PAYLOAD] = memory[at.PAYLOAD]
    row[at.LOG_OIL] = plant[at.OIL_TEMPERATURE]
    write_events(state, valves, axes, plant, memory, row, motors)
    for k in range(row.shape[0] - at.LOG_GROUND):
        point = (k * (heights.shape[0] - 1)) // (at.GROUND_POINTS - 1)
        row[at.LOG_GROUND + k] = heights[point] - memory[at.MEMORY + point]
