"""Long lines within a step of the integrator: their rates, and their elimination from its linear equations.

The lines' equations are in `edp.sim.physics.lines`. (I - g J) k = r is solved for a cylinder's lines in closed form:
flows first, then the pressures at the valve, so that chambers are left as functions of joint rates and pump pressures,
as they are without lines.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import hydraulics, lines
from edp.sim.physics.jit import inlined

# One name per line would fill a page, so the names stay side by side.
# isort: off
from edp.sim.physics.scratch import (
    ACROSS, C_HEAD, C_PORT_HEAD, C_PORT_ROD, C_ROD, DROP_HEAD, DROP_ROD, FROZEN_W, H_BY_1, H_BY_W, HEAD_BY_1,
    HEAD_BY_HEAD, KEPT_HEAD, KEPT_ROD, LEVERS, P_HH, P_HR, P_RH, P_RR, PER_HEAD, PER_ROD, PISTON, PORT_H_BY_1,
    PORT_H_BY_2, PORT_H_BY_W, PORT_HEAD_K, PORT_R_BY_1, PORT_R_BY_2, PORT_R_BY_W, PORT_ROD_K, PUSHED_HEAD,
    PUSHED_ROD, R_BY_1, R_BY_W, RATES, ROD_BY_1, ROD_BY_ROD, SLOPE, T_HH, T_HR, T_RH, T_RR, Z_BY_V, Z_BY_W,
    Z_BY_Z, Z_LEFT,
)  # fmt: skip
# isort: on

Array = NDArray[np.float64]


@inlined
def line_rates(
    i: int,
    v: float,
    flows: tuple[float, float, float, float],
    w: Array,
    axes: Array,
    plant: Array,
    work: tuple[Array, ...],
) -> tuple[float, float]:
    """Return the rates of both chambers and lines of cylinder `i` at speed `v`.

    Returns stiffness over volume of the chambers.

    `flows` are those of `cylinder_flows`; slopes go to `work[SLOPE]`.
    """
    s, e, out = work[FROZEN_W], work[SLOPE], work[RATES]
    head, rod, into_head, into_rod = w[at.HEAD + i], w[at.ROD + i], w[at.FLOW_HEAD + i], w[at.FLOW_ROD + i]
    port_head, port_rod = w[at.PORT_HEAD + i], w[at.PORT_ROD + i]
    wall, half = axes[i, at.LINE_WALL], axes[i, at.PORT_VOLUME]
    # Half of the wall expands with the chamber pressure, half with the valve pressure.
    c_head = 1.0 / (1.0 / (hydraulics.stiffness(head, plant) * s[PER_HEAD + i]) + wall)
    c_rod = 1.0 / (1.0 / (hydraulics.stiffness(rod, plant) * s[PER_ROD + i]) + wall)
    c_port_head = 1.0 / (half / hydraulics.stiffness(port_head, plant) + wall)
    c_port_rod = 1.0 / (half / hydraulics.stiffness(port_rod, plant) + wall)
    piston = axes[i, at.PISTON_LEAK] * plant[at.THINNING]
    through = piston * (head - rod)
    out[at.HEAD + i] = c_head * (into_head - through - axes[i, at.HEAD_AREA] * v)
    out[at.ROD + i] = c_rod * (into_rod + through + axes[i, at.ROD_AREA] * v)
    out[at.PORT_HEAD + i] = c_port_head * (flows[0] - into_head)
    out[at.PORT_ROD + i] = c_port_rod * (flows[1] - into_rod)
    drop_head, slope_head = lines.drop(into_head, i, axes, plant)
    drop_rod, slope_rod = lines.drop(into_rod, i, axes, plant)
    per_inertance = 1.0 / axes[i, at.LINE_INERTANCE]
    out[at.FLOW_HEAD + i] = per_inertance * (port_head - head - drop_head)
    out[at.FLOW_ROD + i] = per_inertance * (port_rod - rod - drop_rod)
    e[i, DROP_HEAD], e[i, DROP_ROD], e[i, PISTON] = slope_head, slope_rod, piston
    e[i, C_PORT_HEAD], e[i, C_PORT_ROD] = c_port_head, c_port_rod
    return c_head, c_rod


@inlined
def eliminate_lines(g: float, axes: Array, s: Array, e: Array) -> None:
    """Eliminate as `eliminate` does, with lines between valves and chambers: flows, valve sides, then chambers.

    With J of `line_rates`: k_q = kept r_q + pushed (k_port - k_chamber).
    """
    for i in range(at.AXES):
        lever, per = s[LEVERS + i], g / axes[i, at.LINE_INERTANCE]
        kept_h, kept_r = 1.0 / (1.0 + per * e[i, DROP_HEAD]), 1.0 / (1.0 + per * e[i, DROP_ROD])
        pushed_h, pushed_r = per * kept_h, per * kept_r
        e[i, KEPT_HEAD], e[i, KEPT_ROD], e[i, PUSHED_HEAD], e[i, PUSHED_ROD] = kept_h, kept_r, pushed_h, pushed_r
        gh, gr = g * e[i, C_PORT_HEAD], g * e[i, C_PORT_ROD]
        hh, hr = 1.0 + gh * (pushed_h - e[i, HEAD_BY_HEAD]), -gh * e[i, ACROSS]
        rh, rr = -gr * e[i, ACROSS], 1.0 + gr * (pushed_r - e[i, ROD_BY_ROD])
        det = 1.0 / (hh * rr - hr * rh)
        p_hh, p_hr, p_rh, p_rr = rr * det, -hr * det, -rh * det, hh * det
        e[i, P_HH], e[i, P_HR], e[i, P_RH], e[i, P_RR] = p_hh, p_hr, p_rh, p_rr
        # What a change of a chamber does to the valve's side.
        by_head, by_rod = gh * pushed_h, gr * pushed_r
        ch, cr, piston = g * e[i, C_HEAD], g * e[i, C_ROD], e[i, PISTON]
        hh = 1.0 + ch * (piston + pushed_h * (1.0 - p_hh * by_head))
        hr = -ch * (piston + pushed_h * p_hr * by_rod)
        rh = -cr * (piston + pushed_r * p_rh * by_head)
        rr = 1.0 + cr * (piston + pushed_r * (1.0 - p_rr * by_rod))
        det = 1.0 / (hh * rr - hr * rh)
        t_hh, t_hr, t_rh, t_rr = rr * det, -hr * det, -rh * det, hh * det
        e[i, T_HH], e[i, T_HR], e[i, T_RH], e[i, T_RR] = t_hh, t_hr, t_rh, t_rr
        by_w_head, by_w_rod = -ch * axes[i, at.HEAD_AREA] * lever, cr * axes[i, at.ROD_AREA] * lever
        head, rod = t_hh * by_w_head + t_hr * by_w_rod, t_rh * by_w_head + t_rr * by_w_rod
        e[i, H_BY_W], e[i, R_BY_W] = head, rod
        e[i, PORT_H_BY_W] = p_hh * by_head * head + p_hr * by_rod * rod
        e[i, PORT_R_BY_W] = p_rh * by_head * head + p_rr * by_rod * rod
        for m in range(2):
            fed_head, fed_rod = gh * e[i, HEAD_BY_1 + m], gr * e[i, ROD_BY_1 + m]
            port_head, port_rod = p_hh * fed_head + p_hr * fed_rod, p_rh * fed_head + p_rr * fed_rod
            into_head, into_rod = ch * pushed_h * port_head, cr * pushed_r * port_rod
            head, rod = t_hh * into_head + t_hr * into_rod, t_rh * into_head + t_rr * into_rod
            e[i, H_BY_1 + m], e[i, R_BY_1 + m] = head, rod
            e[i, PORT_H_BY_1 + m] = port_head + p_hh * by_head * head + p_hr * by_rod * rod
            e[i, PORT_R_BY_1 + m] = port_rod + p_rh * by_head * head + p_rr * by_rod * rod
        left = 1.0 / (1.0 - g * e[i, Z_BY_Z])
        e[i, Z_LEFT] = left
        e[i, Z_BY_W] = g * e[i, Z_BY_V] * lever * left


@inlined
def compute_line_terms(i: int, g: float, r: Array, e: Array) -> tuple[float, float]:
    """Return the chamber terms of cylinder `i` from the right-hand sides `r`.

    The valve-side terms are written to `e`.
    """
    gh, gr = g * e[i, C_PORT_HEAD], g * e[i, C_PORT_ROD]
    flow_h, flow_r = e[i, KEPT_HEAD] * r[at.FLOW_HEAD + i], e[i, KEPT_ROD] * r[at.FLOW_ROD + i]
    at_head, at_rod = r[at.PORT_HEAD + i] - gh * flow_h, r[at.PORT_ROD + i] - gr * flow_r
    port_h = e[i, P_HH] * at_head + e[i, P_HR] * at_rod
    port_r = e[i, P_RH] * at_head + e[i, P_RR] * at_rod
    pushed_h, pushed_r = e[i, PUSHED_HEAD], e[i, PUSHED_ROD]
    head_side = r[at.HEAD + i] + g * e[i, C_HEAD] * (flow_h + pushed_h * port_h)
    rod_side = r[at.ROD + i] + g * e[i, C_ROD] * (flow_r + pushed_r * port_r)
    head = e[i, T_HH] * head_side + e[i, T_HR] * rod_side
    rod = e[i, T_RH] * head_side + e[i, T_RR] * rod_side
    by_head, by_rod = gh * pushed_h * head, gr * pushed_r * rod
    e[i, PORT_HEAD_K] = port_h + e[i, P_HH] * by_head + e[i, P_HR] * by_rod
    e[i, PORT_ROD_K] = port_r + e[i, P_RH] * by_head + e[i, P_RR] * by_rod
    return head, rod


@inlined
def fill_lines(i: int, r: Array, e: Array, out: Array) -> None:
    """Compute the line derivatives of cylinder `i` from the derivatives of joint, pumps and chambers, in `out`."""
    k, b3, b4 = out[at.RATE + i], out[at.PUMP], out[at.PUMP + 1]
    head = e[i, PORT_HEAD_K] + e[i, PORT_H_BY_W] * k + e[i, PORT_H_BY_1] * b3 + e[i, PORT_H_BY_2] * b4
    rod = e[i, PORT_ROD_K] + e[i, PORT_R_BY_W] * k + e[i, PORT_R_BY_1] * b3 + e[i, PORT_R_BY_2] * b4
    out[at.PORT_HEAD + i], out[at.PORT_ROD + i] = head, rod
    pushed_h, pushed_r = e[i, PUSHED_HEAD], e[i, PUSHED_ROD]
    out[at.FLOW_HEAD + i] = e[i, KEPT_HEAD] * r[at.FLOW_HEAD + i] + pushed_h * (head - out[at.HEAD + i])
    out[at.FLOW_ROD + i] = e[i, KEPT_ROD] * r[at.FLOW_ROD + i] + pushed_r * (rod - out[at.ROD + i])
