"""Orifices, checks, reliefs and leakage of one cylinder, and the stiffness of its oil."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import lines
from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]
SMOOTH2 = 1e5**2
"""Square of the pressure difference (Pa) below which the flow through an orifice is laminar."""
UNLOADING = 1.5
"""Pressure of the unloading valve of a load-sensing block above the highest load, in load-sensing margins."""


@inlined
def orifice(dp: float) -> tuple[float, float]:
    """Return dp / (dp^2 + delta^2)^(1/4), which is sqrt(dp) smoothed over 1 bar, and its derivative."""
    q2 = dp * dp + SMOOTH2
    # Two square roots replace the slower pow(q2, 0.25).
    root = math.sqrt(math.sqrt(q2))
    inverse = 1.0 / (q2 * root)
    return dp * q2 * inverse, (q2 - 0.5 * dp * dp) * inverse


@inlined
def check_orifice(dp: float, leak: float) -> tuple[float, float]:
    """Compute an orifice after a check valve, which passes the fraction `leak` of the flow backwards."""
    flow, slope = orifice(dp)
    passed = leak if dp < 0.0 else 1.0
    return passed * flow, passed * slope


@inlined
def stiffness(pressure: float, plant: Array) -> float:
    """Return the effective bulk modulus (Pa) of oil with free air at a gauge pressure (Pa), isothermal."""
    # 0.1 bar absolute, as the clamped pressures: a stage of ROS2 may fall below it, where a / p has no meaning.
    absolute = max(pressure + at.ATMOSPHERE, 1e4)
    air = plant[at.AIR] * at.ATMOSPHERE
    # (1 + a) / (1 / beta + a / p) with a = air / p, in one division
    bulk = plant[at.BULK_MODULUS]
    stiffness: float = bulk * absolute * (absolute + air) / (absolute * absolute + bulk * air)
    return stiffness


@inlined
def port_flows(pressure: float, relief: float, leak: float, plant: Array) -> tuple[float, float]:
    """Return inflow (m^3/s) of one chamber through relief, make-up check and spool leakage, and its slope (<= 0)."""
    flow, slope = -leak * (pressure - plant[at.TANK]), -leak
    # A slope instead of a hard limit: real reliefs let pressure rise while they open, and the Jacobian needs it.
    if pressure > relief:
        flow -= plant[at.PORT_SLOPE] * (pressure - relief)
        slope -= plant[at.PORT_SLOPE]
    if pressure < plant[at.TANK]:
        q, d = orifice(plant[at.TANK] - pressure)
        flow += plant[at.ANTI_CAVITATION] * q
        slope -= plant[at.ANTI_CAVITATION] * d
    return flow, slope


@inlined
def section(
    area: float, supply: float, load: float, highest: float, leak: float, most: float
) -> tuple[float, float, float]:
    """Flow from a pump line through a load check into a chamber, and its slopes by pump pressure and by load.

    `highest` is the load pressure that a section with a compensator after the spool signals to its pump instead of its
    own lower load. `most` is the pressure drop (Pa) that a compensator before the spool keeps, independent of pump and
    load.
    """
    if area <= 0.0:
        return 0.0, 0.0, 0.0
    if supply - load > most:
        return area * check_orifice(most, leak)[0], 0.0, 0.0
    # Behind a compensator that shows the higher load, the flow does not depend on the section's own load.
    q, d = check_orifice(supply - max(load, highest), leak)
    return area * q, area * d, (area * d if load >= highest else 0.0)


@inlined
def drain(area: float, dp: float, leak: float) -> tuple[float, float]:
    """Flow through an opening to tank or, behind a check, to the other chamber, and its slope."""
    if area <= 0.0:
        return 0.0, 0.0
    q, d = check_orifice(dp, leak)
    return area * q, area * d


@inlined
def cylinder_flows(
    i: int,
    pressures: tuple[float, float, float, float],
    highest: tuple[float, float],
    opened: Array,
    axes: Array,
    plant: Array,
) -> tuple[tuple[float, float, float, float], tuple[float, float, float, float, float, float, float]]:
    """Compute all flows of cylinder `i` at head, rod and both pump pressures (Pa); with lines, at their valve ends.

    Returns:
        Net inflow of head and rod chamber and what is drawn from either pump, m^3/s; then the slopes: head by head,
        rod by rod, either by the other, head by pump 1 and 2, rod by pump 1 and 2.
    """
    head, rod, pump_1, pump_2 = pressures
    check, regeneration_check, tank = axes[i, at.CHECK], plant[at.REGEN_CHECK], plant[at.TANK]
    head_leak = axes[i, at.HEAD_LEAK] * plant[at.THINNING]
    rod_leak = axes[i, at.ROD_LEAK] * plant[at.THINNING]
    # Where lines lie between, the pistons leak at their other ends (`integrator.rates`).
    leak = 0.0 if plant[at.LINES] > 0.0 else axes[i, at.PISTON_LEAK] * plant[at.THINNING]
    most = plant[at.SECTION_DROP]
    h, h_h = port_flows(head, axes[i, at.RELIEF_HEAD], head_leak, plant)
    r, r_r = port_flows(rod, axes[i, at.RELIEF_ROD], rod_leak, plant)
    head_1, h_1, h_load_1 = section(opened[i, at.HEAD_IN_1], pump_1, head, highest[0], check, most)
    head_2, h_2, h_load_2 = section(opened[i, at.HEAD_IN_2], pump_2, head, highest[1], check, most)
    rod_1, r_1, r_load_1 = section(opened[i, at.ROD_IN_1], pump_1, rod, highest[0], check, most)
    rod_2, r_2, r_load_2 = section(opened[i, at.ROD_IN_2], pump_2, rod, highest[1], check, most)
    # Spools open to tank have no check valve: 1.0 lets a cavitating chamber draw oil back.
    head_out, h_out = drain(opened[i, at.HEAD_OUT], head - tank, 1.0)
    rod_out, r_out = drain(opened[i, at.ROD_OUT], rod - tank, 1.0)
    down, by_down = drain(opened[i, at.HEAD_TO_ROD], head - rod, regeneration_check)
    up, by_up = drain(opened[i, at.ROD_TO_HEAD], rod - head, regeneration_check)
    through, across = leak * (head - rod) + down - up, leak + by_down + by_up
    flows = (h + head_1 + head_2 - head_out - through, r + rod_1 + rod_2 - rod_out + through)
    slopes = (h_h - h_load_1 - h_load_2 - h_out - across, r_r - r_load_1 - r_load_2 - r_out - across, across)
    return (*flows, head_1 + rod_1, head_2 + rod_2), (*slopes, h_1, h_2, r_1, r_2)


@inlined
def highest_load(m: int, state: Array, opened: Array, plant: Array) -> float:
    """Return the largest pressure (Pa) among the chambers connected to pump `m`; a very low value without any."""
    most, port = -1e9, lines.first_valve_pressure(plant)
    for i in range(at.AXES):
        if opened[i, at.HEAD_IN_1 + m] > 0.0:
            most = max(most, state[port + i])
        if opened[i, at.ROD_IN_1 + m] > 0.0:
            most = max(most, state[port + at.AXES + i])
    return most


@inlined
def relief_of(highest: float, plant: Array) -> float:
    """Return the pressure (Pa) above which a pump line opens to tank.

    The main relief's, or an unloading valve's above the load.

    A pump that senses loads swings back late; until then a valve set to `UNLOADING` margins above the `highest` load
    takes its oil, as in closed-centre blocks.
    """
    relief: float = plant[at.PUMP_RELIEF]
    if plant[at.LOAD_MARGIN] > 0.0:
        relief = min(relief, max(highest, plant[at.TANK]) + UNLOADING * plant[at.LOAD_MARGIN])
    return relief


@inlined
def pump_outflow(pressure: float, bypass: float, relief: float, plant: Array) -> tuple[float, float]:
    """Flow (m^3/s) from a pump line through open centre and a valve that opens at `relief` (Pa), and its slope."""
    q, d = orifice(pressure - plant[at.TANK])
    flow, slope = bypass * q, bypass * d
    if pressure > relief:
        flow += plant[at.RELIEF_SLOPE] * (pressure - relief)
        slope += plant[at.RELIEF_SLOPE]
    return flow, slope
