"""The linear equations of a step, (I - g J) k = r: chambers, lines, bristles and motors are eliminated in closed form.

What is left are three joint rates and two pump pressures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import line_step, terramechanics
from edp.sim.physics import motors as places
from edp.sim.physics.jit import inlined
from edp.sim.physics.motors import Motors

# One name per line would fill a page, so the names stay side by side.
# isort: off
from edp.sim.physics.scratch import (
    ACROSS, BRISTLE_K, C_HEAD, C_PUMP_1, C_ROD, CONTACT, F_BY_V, F_BY_Z, FROZEN_W, H_BY_1, H_BY_2, H_BY_W, HEAD_BY_1,
    HEAD_BY_2, HEAD_BY_HEAD, HEAD_K, LEVERS, LOST_1, LU, MASS, PORT_H_BY_W, PORT_HEAD_K, PORT_ROD_K, PUMP_ROW,
    R_BY_1, R_BY_2, R_BY_W, RHS, ROD_BY_1, ROD_BY_2, ROD_BY_ROD, ROD_K, SLOPE, T_HH, T_HR, T_RH, T_RR, Z_BY_V, Z_BY_W,
    Z_BY_Z, Z_LEFT,
)  # fmt: skip
# isort: on

Array = NDArray[np.float64]


@inlined
def eliminate(g: float, axes: Array, s: Array, e: Array) -> None:
    """Express chamber pressures and bristles as linear functions of joint rates and pump pressures, in `e`."""
    for i in range(at.AXES):
        lever = s[LEVERS + i]
        ch, cr = g * e[i, C_HEAD], g * e[i, C_ROD]
        hh, hr = 1.0 - ch * e[i, HEAD_BY_HEAD], -ch * e[i, ACROSS]
        rh, rr = -cr * e[i, ACROSS], 1.0 - cr * e[i, ROD_BY_ROD]
        # Never below 1: all slopes of the flows are <= 0, so Cramer's rule needs no pivot.
        det = 1.0 / (hh * rr - hr * rh)
        t_hh, t_hr, t_rh, t_rr = rr * det, -hr * det, -rh * det, hh * det
        e[i, T_HH], e[i, T_HR], e[i, T_RH], e[i, T_RR] = t_hh, t_hr, t_rh, t_rr
        by_w_head, by_w_rod = -ch * axes[i, at.HEAD_AREA] * lever, cr * axes[i, at.ROD_AREA] * lever
        e[i, H_BY_W] = t_hh * by_w_head + t_hr * by_w_rod
        e[i, R_BY_W] = t_rh * by_w_head + t_rr * by_w_rod
        for m in range(2):
            head, rod = ch * e[i, HEAD_BY_1 + m], cr * e[i, ROD_BY_1 + m]
            e[i, H_BY_1 + m] = t_hh * head + t_hr * rod
            e[i, R_BY_1 + m] = t_rh * head + t_rr * rod
        left = 1.0 / (1.0 - g * e[i, Z_BY_Z])
        e[i, Z_LEFT] = left
        e[i, Z_BY_W] = g * e[i, Z_BY_V] * lever * left


@inlined
def factorise(g: float, axes: Array, long: bool, work: tuple[Array, ...], motors: Motors | None) -> None:
    """Factorise the reduced matrix of I - g J, 5x5, into `work[LU]`, without pivoting, since its diagonal dominates.

    `long` says whether lines lie between valves and chambers.
    """
    s, lu, e, contact = work[FROZEN_W], work[LU], work[SLOPE], work[CONTACT]
    # The pump load is the pressure at the sections: of the chambers, or of the line ends at the valve.
    seen = H_BY_W
    if long:
        line_step.eliminate_lines(g, axes, s, e)
        seen = PORT_H_BY_W
    else:
        eliminate(g, axes, s, e)
    # Rows of the joint rates stay multiplied by M: no inverse of the mass matrix is needed.
    lu[0, 0], lu[0, 1], lu[0, 2] = s[MASS], s[MASS + 1], s[MASS + 2]
    lu[1, 0], lu[1, 1], lu[1, 2] = s[MASS + 1], s[MASS + 3], s[MASS + 4]
    lu[2, 0], lu[2, 1], lu[2, 2] = s[MASS + 2], s[MASS + 4], s[MASS + 5]
    if contact[terramechanics.ON] > 0.0:
        for i in range(3):
            for j in range(3):
                lu[i, j] += g * contact[terramechanics.DAMPING + 3 * i + j]
    gc_1, gc_2 = g * e[PUMP_ROW, C_PUMP_1], g * e[PUMP_ROW, C_PUMP_1 + 1]
    l33, l34 = 1.0 + gc_1 * e[PUMP_ROW, LOST_1], 0.0
    l44, l43 = 1.0 + gc_2 * e[PUMP_ROW, LOST_1 + 1], 0.0
    for i in range(at.AXES):
        head_area, rod_area, lever = axes[i, at.HEAD_AREA], axes[i, at.ROD_AREA], s[LEVERS + i]
        arm = g * lever
        force_by_w = head_area * e[i, H_BY_W] - rod_area * e[i, R_BY_W]
        lu[i, i] -= arm * (force_by_w - e[i, F_BY_Z] * e[i, Z_BY_W] - e[i, F_BY_V] * lever)
        h_1, h_2, r_1, r_2 = e[i, HEAD_BY_1], e[i, HEAD_BY_2], e[i, ROD_BY_1], e[i, ROD_BY_2]
        lu[i, 3] = -arm * (head_area * e[i, H_BY_1] - rod_area * e[i, R_BY_1])
        lu[i, 4] = -arm * (head_area * e[i, H_BY_2] - rod_area * e[i, R_BY_2])
        h_by_w, h_by_1, h_by_2 = e[i, seen], e[i, seen + 1], e[i, seen + 2]
        r_by_w, r_by_1, r_by_2 = e[i, seen + 3], e[i, seen + 4], e[i, seen + 5]
        lu[3, i] = -gc_1 * (h_1 * h_by_w + r_1 * r_by_w)
        lu[4, i] = -gc_2 * (h_2 * h_by_w + r_2 * r_by_w)
        l33 += gc_1 * (h_1 + r_1 - h_1 * h_by_1 - r_1 * r_by_1)
        l34 -= gc_1 * (h_1 * h_by_2 + r_1 * r_by_2)
        l43 -= gc_2 * (h_2 * h_by_1 + r_2 * r_by_1)
        l44 += gc_2 * (h_2 + r_2 - h_2 * h_by_2 - r_2 * r_by_2)
    if motors is not None:
        own = places.eliminate(g, (gc_1, gc_2), motors)
        l33 += own[0]
        l44 += own[1]
    lu[3, 3], lu[3, 4], lu[4, 3], lu[4, 4] = l33, l34, l43, l44
    for k in range(5):
        inverse = 1.0 / lu[k, k]
        # The reciprocal pivot is kept, since `solve` runs twice for each factorisation.
        lu[k, k] = inverse
        for i in range(k + 1, 5):
            lu[i, k] *= inverse
            for j in range(k + 1, 5):
                lu[i, j] -= lu[i, k] * lu[k, j]


@inlined
def solve(g: float, axes: Array, long: bool, work: tuple[Array, ...], out: Array, motors: Motors | None) -> None:
    """Solve (I - g J) k = work[RHS] (rows of the joint rates multiplied by M); k goes to `out`, laid out as a state.

    `long` says whether lines lie between valves and chambers. That of motors goes to `motors[K2]`.
    """
    s, lu, e, r = work[FROZEN_W], work[LU], work[SLOPE], work[RHS]
    b3, b4 = r[at.PUMP], r[at.PUMP + 1]
    gc_1, gc_2 = g * e[PUMP_ROW, C_PUMP_1], g * e[PUMP_ROW, C_PUMP_1 + 1]
    for i in range(at.AXES):
        if long:
            head, rod = line_step.compute_line_terms(i, g, r, e)
            seen_head, seen_rod = e[i, PORT_HEAD_K], e[i, PORT_ROD_K]
        else:
            head = e[i, T_HH] * r[at.HEAD + i] + e[i, T_HR] * r[at.ROD + i]
            rod = e[i, T_RH] * r[at.HEAD + i] + e[i, T_RR] * r[at.ROD + i]
            seen_head, seen_rod = head, rod
        z = r[at.BRISTLE + i] * e[i, Z_LEFT]
        e[i, HEAD_K], e[i, ROD_K], e[i, BRISTLE_K] = head, rod, z
        force = axes[i, at.HEAD_AREA] * head - axes[i, at.ROD_AREA] * rod - e[i, F_BY_Z] * z
        r[at.RATE + i] += g * s[LEVERS + i] * force
        b3 += gc_1 * (e[i, HEAD_BY_1] * seen_head + e[i, ROD_BY_1] * seen_rod)
        b4 += gc_2 * (e[i, HEAD_BY_2] * seen_head + e[i, ROD_BY_2] * seen_rod)
    if motors is not None:
        own = places.known(g, (gc_1, gc_2), motors)
        b3 += own[0]
        b4 += own[1]
    b0, b1, b2 = r[at.RATE], r[at.RATE + 1], r[at.RATE + 2]
    b1 -= lu[1, 0] * b0
    b2 -= lu[2, 0] * b0 + lu[2, 1] * b1
    b3 -= lu[3, 0] * b0 + lu[3, 1] * b1 + lu[3, 2] * b2
    b4 -= lu[4, 0] * b0 + lu[4, 1] * b1 + lu[4, 2] * b2 + lu[4, 3] * b3
    b4 *= lu[4, 4]
    b3 = (b3 - lu[3, 4] * b4) * lu[3, 3]
    b2 = (b2 - lu[2, 3] * b3 - lu[2, 4] * b4) * lu[2, 2]
    b1 = (b1 - lu[1, 2] * b2 - lu[1, 3] * b3 - lu[1, 4] * b4) * lu[1, 1]
    b0 = (b0 - lu[0, 1] * b1 - lu[0, 2] * b2 - lu[0, 3] * b3 - lu[0, 4] * b4) * lu[0, 0]
    out[at.RATE], out[at.RATE + 1], out[at.RATE + 2], out[at.PUMP], out[at.PUMP + 1] = b0, b1, b2, b3, b4
    for i in range(at.AXES):
        k = out[at.RATE + i]
        out[at.HEAD + i] = e[i, HEAD_K] + e[i, H_BY_W] * k + e[i, H_BY_1] * b3 + e[i, H_BY_2] * b4
        out[at.ROD + i] = e[i, ROD_K] + e[i, R_BY_W] * k + e[i, R_BY_1] * b3 + e[i, R_BY_2] * b4
        out[at.BRISTLE + i] = e[i, BRISTLE_K] + e[i, Z_BY_W] * k
        if long:
            line_step.fill_lines(i, r, e, out)
    if motors is not None:
        places.fill(b3, b4, motors)
