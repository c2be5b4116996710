"""Two pumps: electronic positive control, common power limit, first-order displacement, open-centre bypass."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]


@inlined
def demand(valves: Array, axes: Array, plant: Array) -> tuple[float, float]:
    """Displacement asked for by the pilots, as a share of full, for both pumps."""
    first = second = plant[at.MIN_DISPLACEMENT]
    for j in range(at.SPOOLS):
        i = j if j < 3 else j - 3
        pilot = valves[j, at.PILOT]
        gain = axes[i, at.DEMAND_EXTEND] if pilot >= 0.0 else axes[i, at.DEMAND_RETRACT]
        # Demand begins at 10 % of the pilot, below usual dead bands of the spools (12 to 14 %), and is full at 85 %.
        asked = min(gain * max(abs(pilot) - 0.1, 0.0) * (1.0 / 0.75), 1.0)
        pump = axes[i, at.PRIMARY_PUMP] if j < 3 else axes[i, at.CONFLUX_PUMP]
        if pump == 0.0:
            first = max(first, asked)
        else:
            second = max(second, asked)
    return first, second


@inlined
def displacement_step(state: Array, valves: Array, axes: Array, plant: Array, share: float) -> None:
    """Move both displacements towards demand under the power limit; `share` = exp(-step / time constant)."""
    first, second = demand(valves, axes, plant)
    # A line below tank pressure takes no power from the other pump's share.
    power = plant[at.MAX_FLOW] * (first * max(state[at.PUMP], 0.0) + second * max(state[at.PUMP + 1], 0.0))
    # At least 1 W: idle pumps do not divide by zero.
    limit = min(1.0, plant[at.POWER_LIMIT] / max(power, 1.0))
    d = at.DISPLACEMENT
    state[d] = first * limit + (state[d] - first * limit) * share
    state[d + 1] = second * limit + (state[d + 1] - second * limit) * share


@inlined
def bypass_conductances(valves: Array, axes: Array, plant: Array) -> tuple[float, float]:
    """Open centre of both pumps: closes as any spool of a pump moves, product of (1 - |s| / s_closed)^2."""
    first = second = plant[at.BYPASS]
    per_closed = 1.0 / plant[at.BYPASS_CLOSED]
    for j in range(at.SPOOLS):
        left = max(1.0 - abs(valves[j, at.SPOOL]) * per_closed, 0.0)
        if (axes[j, at.PRIMARY_PUMP] if j < 3 else axes[j - 3, at.CONFLUX_PUMP]) == 0.0:
            first *= left * left
        else:
            second *= left * left
    return first, second


def displacement_share(time_constant_s: float, step_s: float) -> float:
    """exp(-step / time constant), the exact first-order step."""
    return math.exp(-step_s / time_constant_s)
