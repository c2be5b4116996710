"""Two pumps: positive control or load sensing, common power limit, first-order displacement, open-centre bypass.

Load sensing (Krus, On Load Sensing Fluid Power Systems, Linkoping 1988; Merritt 1967, pressure-compensated pumps):
a valve at each pump compares its pressure p with the highest load p_L of its open sections and swings the pump so that
p stays `load_margin` above, or at the main relief's pressure if that is lower:

    x = (min(p_L + margin, relief) - p) / (DROOP margin), held within the least displacement and 1,

behind the first-order lag of the displacement; the power limit stays. With `DROOP` the margin falls by that share from
no flow to full. If the flow is insufficient (full displacement or power limit), p falls towards the loads; the sections
then determine the distribution, see `flow_sharing`. The open centre is a bleed orifice that does not close.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import lines
from edp.sim.physics import motors as places
from edp.sim.physics.jit import inlined
from edp.sim.physics.motors import Motors

Array = NDArray[np.float64]
DROOP = 0.3
"""Pressure drop of a load-sensing pump from zero flow to full flow, as a fraction of the margin. Usual values are 20 to
30 %."""


@inlined
def pump_of(spool: int, axes: Array) -> float:
    """Return the number of the pump that feeds a spool: axis spools come first, then conflux spools."""
    pump: float = axes[spool, at.PRIMARY_PUMP] if spool < at.AXES else axes[spool - at.AXES, at.CONFLUX_PUMP]
    return pump


@inlined
def wish(gain: float, pilot: float) -> float:
    """Return the displacement requested by a pilot, as a fraction of full displacement."""
    # Demand begins at 10 % of the pilot, below usual dead bands of the spools (12 to 14 %), and is full at 85 %.
    return min(gain * max(abs(pilot) - 0.1, 0.0) * (1.0 / 0.75), 1.0)


@inlined
def demand(valves: Array, axes: Array, plant: Array, motors: Motors | None = None) -> tuple[float, float]:
    """Return the displacements of both pumps requested by the pilots, as fractions of full displacement."""
    first = second = plant[at.MIN_DISPLACEMENT]
    for j in range(at.SPOOLS):
        i = j % at.AXES
        pilot = valves[j, at.PILOT]
        gain = axes[i, at.DEMAND_EXTEND] if pilot >= 0.0 else axes[i, at.DEMAND_RETRACT]
        asked = wish(gain, pilot)
        if pump_of(j, axes) == 0.0:
            first = max(first, asked)
        else:
            second = max(second, asked)
    if motors is not None:
        for i in range(at.MOTORS):
            asked = wish(motors[places.NUMBERS][i, at.MOTOR_DEMAND], motors[places.VALVES][i, at.PILOT])
            if motors[places.NUMBERS][i, at.MOTOR_PUMP] == 0.0:
                first = max(first, asked)
            else:
                second = max(second, asked)
    return first, second


@inlined
def find_highest_loads(
    state: Array, valves: Array, axes: Array, plant: Array, motors: Motors | None = None
) -> tuple[float, float]:
    """Return the highest chamber pressure (Pa) open to each pump's spools; the tank pressure if missing."""
    first = second = plant[at.TANK]
    port = lines.first_valve_pressure(plant)
    for j in range(at.SPOOLS):
        i, spool = j % at.AXES, valves[j, at.SPOOL]
        if j < at.AXES:
            extend, retract = axes[i, at.DEAD_BAND_EXTEND], axes[i, at.DEAD_BAND_RETRACT]
        else:
            extend, retract = axes[i, at.CONFLUX_DEAD_BAND_EXTEND], axes[i, at.CONFLUX_DEAD_BAND_RETRACT]
        load = plant[at.TANK]
        if spool > extend:
            load = state[port + i]
        elif -spool > retract:
            load = state[port + at.AXES + i]
        if pump_of(j, axes) == 0.0:
            first = max(first, load)
        else:
            second = max(second, load)
    if motors is not None:
        places.open_sections(motors)
        first = max(first, places.highest_load(0, motors[places.STATE], motors))
        second = max(second, places.highest_load(1, motors[places.STATE], motors))
    return first, second


@inlined
def asked(state: Array, valves: Array, axes: Array, plant: Array, motors: Motors | None = None) -> tuple[float, float]:
    """Return the displacements of both pumps requested by pilots or loads, as fractions of full displacement."""
    margin, least = plant[at.LOAD_MARGIN], plant[at.MIN_DISPLACEMENT]
    if margin <= 0.0:
        return demand(valves, axes, plant, motors)
    first, second = find_highest_loads(state, valves, axes, plant, motors)
    per_band = 1.0 / (DROOP * margin)
    first = (min(first + margin, plant[at.PUMP_RELIEF]) - state[at.PUMP]) * per_band
    second = (min(second + margin, plant[at.PUMP_RELIEF]) - state[at.PUMP + 1]) * per_band
    return min(max(first, least), 1.0), min(max(second, least), 1.0)


@inlined
def displacement_step(
    state: Array, valves: Array, axes: Array, plant: Array, share: float, motors: Motors | None = None
) -> None:
    """Move both displacements towards demand under the power limit; `share` = exp(-step / time constant)."""
    first, second = asked(state, valves, axes, plant, motors)
    # A line below tank pressure does not increase the power of the other pump.
    power = plant[at.MAX_FLOW] * (first * max(state[at.PUMP], 0.0) + second * max(state[at.PUMP + 1], 0.0))
    # At least 1 W: idle pumps do not divide by zero.
    limit = min(1.0, plant[at.POWER_LIMIT] / max(power, 1.0))
    d = at.DISPLACEMENT
    state[d] = first * limit + (state[d] - first * limit) * share
    state[d + 1] = second * limit + (state[d + 1] - second * limit) * share


@inlined
def bypass_conductances(valves: Array, axes: Array, plant: Array, motors: Motors | None = None) -> tuple[float, float]:
    """Open centre of both pumps: closes as any spool of a pump moves, product of (1 - |s| / s_closed)^2.

    With load sensing it is a bleed orifice that stays.
    """
    first = second = plant[at.BYPASS]
    if plant[at.LOAD_MARGIN] > 0.0:
        return first, second
    per_closed = 1.0 / plant[at.BYPASS_CLOSED]
    for j in range(at.SPOOLS):
        left = max(1.0 - abs(valves[j, at.SPOOL]) * per_closed, 0.0)
        if pump_of(j, axes) == 0.0:
            first *= left * left
        else:
            second *= left * left
    if motors is not None:
        for i in range(at.MOTORS):
            left = max(1.0 - abs(motors[places.VALVES][i, at.SPOOL]) * per_closed, 0.0)
            if motors[places.NUMBERS][i, at.MOTOR_PUMP] == 0.0:
                first *= left * left
            else:
                second *= left * left
    return first, second


def displacement_share(time_constant_s: float, step_s: float) -> float:
    """Return the exp(-step / time constant), the exact first-order step."""
    return math.exp(-step_s / time_constant_s)
