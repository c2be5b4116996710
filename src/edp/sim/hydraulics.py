"""Orifices, checks, reliefs and leakage of one cylinder, and the stiffness of its oil."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import layout as at
from edp.sim.jit import compiled

Array = NDArray[np.float64]
SMOOTH2 = 1e5**2
"""Square of the pressure (Pa) below which an orifice turns laminar."""


@compiled
def orifice(dp: float) -> tuple[float, float]:
    """Dp / (dp^2 + delta^2)^(1/4), which is sqrt(dp) smoothed over 1 bar, and its derivative."""
    q = math.sqrt(dp * dp + SMOOTH2)
    root = math.sqrt(q)
    return dp / root, (0.5 * dp * dp + SMOOTH2) / (q * q * root)


@compiled
def check_orifice(dp: float, leak: float) -> tuple[float, float]:
    """An orifice behind a check valve: passes `leak` of the flow backwards."""
    flow, slope = orifice(dp)
    if dp < 0.0:
        return leak * flow, leak * slope
    return flow, slope


@compiled
def stiffness(pressure: float, plant: Array) -> float:
    """Effective bulk modulus (Pa) of oil with free air at a gauge pressure (Pa), isothermal."""
    absolute = max(pressure + at.ATMOSPHERE, 1e4)
    air = plant[at.AIR] * at.ATMOSPHERE / absolute
    return (1.0 + air) / (1.0 / plant[at.BULK_MODULUS] + air / absolute)


@compiled
def port_flows(pressure: float, relief: float, leak: float, plant: Array) -> tuple[float, float]:
    """Inflow (m^3/s) of one chamber through relief, make-up check and spool leakage, and its slope (<= 0)."""
    flow, slope = -leak * (pressure - plant[at.TANK]), -leak
    if pressure > relief:
        flow -= plant[at.PORT_SLOPE] * (pressure - relief)
        slope -= plant[at.PORT_SLOPE]
    if pressure < plant[at.TANK]:
        q, d = orifice(plant[at.TANK] - pressure)
        flow += plant[at.ANTI_CAVITATION] * q
        slope -= plant[at.ANTI_CAVITATION] * d
    return flow, slope


@compiled
def meter_in(i: int, state: Array, opened: Array, plant: Array, f: Array) -> None:
    """Add flows from both pumps through load checks to head and rod chamber of cylinder `i` into its row `f`."""
    for m in range(2):
        supply = state[at.PUMP + m]
        if opened[at.HEAD_IN_1 + m] > 0.0:
            q, d = check_orifice(supply - state[at.HEAD + i], plant[at.CHECK])
            q, d = q * opened[at.HEAD_IN_1 + m], d * opened[at.HEAD_IN_1 + m]
            f[at.Q_HEAD] += q
            f[at.HEAD_BY_HEAD] -= d
            f[at.HEAD_BY_1 + m] += d
            f[at.DRAWN_1 + m] += q
        if opened[at.ROD_IN_1 + m] > 0.0:
            q, d = check_orifice(supply - state[at.ROD + i], plant[at.CHECK])
            q, d = q * opened[at.ROD_IN_1 + m], d * opened[at.ROD_IN_1 + m]
            f[at.Q_ROD] += q
            f[at.ROD_BY_ROD] -= d
            f[at.ROD_BY_1 + m] += d
            f[at.DRAWN_1 + m] += q


@compiled
def meter_out(head: float, rod: float, opened: Array, plant: Array, f: Array) -> None:
    """Add flows to tank and through the regeneration checks into the row `f`."""
    if opened[at.HEAD_OUT] > 0.0:
        q, d = orifice(head - plant[at.TANK])
        f[at.Q_HEAD] -= q * opened[at.HEAD_OUT]
        f[at.HEAD_BY_HEAD] -= d * opened[at.HEAD_OUT]
    if opened[at.ROD_OUT] > 0.0:
        q, d = orifice(rod - plant[at.TANK])
        f[at.Q_ROD] -= q * opened[at.ROD_OUT]
        f[at.ROD_BY_ROD] -= d * opened[at.ROD_OUT]
    through = d_through = 0.0
    if opened[at.HEAD_TO_ROD] > 0.0:
        q, d = check_orifice(head - rod, plant[at.CHECK])
        through, d_through = q * opened[at.HEAD_TO_ROD], d * opened[at.HEAD_TO_ROD]
    if opened[at.ROD_TO_HEAD] > 0.0:
        q, d = check_orifice(rod - head, plant[at.CHECK])
        through, d_through = through - q * opened[at.ROD_TO_HEAD], d_through + d * opened[at.ROD_TO_HEAD]
    f[at.Q_HEAD] -= through
    f[at.Q_ROD] += through
    f[at.HEAD_BY_HEAD] -= d_through
    f[at.HEAD_BY_ROD] += d_through
    f[at.ROD_BY_HEAD] += d_through
    f[at.ROD_BY_ROD] -= d_through


@compiled
def cylinder_flows(i: int, state: Array, opened: Array, axes: Array, plant: Array, flow: Array) -> None:
    """All flows of cylinder `i` and their derivatives into `flow[i]`, shape (FLOWS,)."""
    f, a = flow[i], axes[i]
    head, rod = state[at.HEAD + i], state[at.ROD + i]
    for n in range(at.FLOWS):
        f[n] = 0.0
    f[at.Q_HEAD], f[at.HEAD_BY_HEAD] = port_flows(head, a[at.RELIEF_HEAD], a[at.SPOOL_LEAK], plant)
    f[at.Q_ROD], f[at.ROD_BY_ROD] = port_flows(rod, a[at.RELIEF_ROD], a[at.SPOOL_LEAK], plant)
    leak = a[at.PISTON_LEAK]
    f[at.Q_HEAD] -= leak * (head - rod)
    f[at.Q_ROD] += leak * (head - rod)
    f[at.HEAD_BY_HEAD] -= leak
    f[at.ROD_BY_ROD] -= leak
    f[at.HEAD_BY_ROD] += leak
    f[at.ROD_BY_HEAD] += leak
    meter_in(i, state, opened[i], plant, f)
    meter_out(head, rod, opened[i], plant, f)


@compiled
def pump_outflow(pressure: float, bypass: float, plant: Array) -> tuple[float, float]:
    """Flow (m^3/s) from a pump line through open centre and main relief, and its slope."""
    q, d = orifice(pressure - plant[at.TANK])
    flow, slope = bypass * q, bypass * d
    if pressure > plant[at.PUMP_RELIEF]:
        flow += plant[at.RELIEF_SLOPE] * (pressure - plant[at.PUMP_RELIEF])
        slope += plant[at.RELIEF_SLOPE]
    return flow, slope
