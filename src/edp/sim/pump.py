"""Two pumps: electronic positive control, common power limit, first-order displacement, open-centre bypass."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import layout as at
from edp.sim.jit import compiled

Array = NDArray[np.float64]


@compiled
def demand(valves: Array, axes: Array, plant: Array) -> tuple[float, float]:
    """Displacement asked for by the pilots, as a share of full, for both pumps."""
    first = second = plant[at.MIN_DISPLACEMENT]
    for j in range(at.SPOOLS):
        i = j % 3
        pilot = valves[j, at.PILOT]
        gain = axes[i, at.DEMAND_EXTEND] if pilot >= 0.0 else axes[i, at.DEMAND_RETRACT]
        asked = min(gain * max(abs(pilot) - 0.1, 0.0) / 0.75, 1.0)
        pump = axes[i, at.PRIMARY_PUMP] if j < 3 else axes[i, at.CONFLUX_PUMP]
        if pump == 0.0:
            first = max(first, asked)
        else:
            second = max(second, asked)
    return first, second


@compiled
def displacement_step(state: Array, valves: Array, axes: Array, plant: Array, share: float) -> None:
    """Move both displacements towards demand under the power limit; `share` = exp(-step / time constant)."""
    first, second = demand(valves, axes, plant)
    power = plant[at.MAX_FLOW] * (first * max(state[at.PUMP], 0.0) + second * max(state[at.PUMP + 1], 0.0))
    limit = min(1.0, plant[at.POWER_LIMIT] / max(power, 1.0))
    d = at.DISPLACEMENT
    state[d] = first * limit + (state[d] - first * limit) * share
    state[d + 1] = second * limit + (state[d + 1] - second * limit) * share


@compiled
def bypass_conductance(pump: int, valves: Array, axes: Array, plant: Array) -> float:
    """Open centre of one pump: closes as any of its spools moves, product of (1 - |s| / s_closed)^2."""
    share = 1.0
    for j in range(at.SPOOLS):
        fed_by = axes[j % 3, at.PRIMARY_PUMP] if j < 3 else axes[j % 3, at.CONFLUX_PUMP]
        if fed_by == pump:
            left = max(1.0 - abs(valves[j, at.SPOOL]) / plant[at.BYPASS_CLOSED], 0.0)
            share *= left * left
    return plant[at.BYPASS] * share


def displacement_share(time_constant_s: float, step_s: float) -> float:
    """exp(-step / time constant), the exact first-order step."""
    return math.exp(-step_s / time_constant_s)
