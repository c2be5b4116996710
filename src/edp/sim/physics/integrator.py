"""One step of the plant: Strang splitting around a two-stage, L-stable Rosenbrock method (ROS2).

Within a step the geometry, the mass matrix, the spools and the soil are frozen at mid-step; ROS2 advances
w = (psi', p_head, p_rod, p_pump, z), and the pressures and flows of long lines where a machine has them. Chamber
pressures, lines and bristles are eliminated in closed form, which leaves three joint rates and two pump pressures.
ROS2 keeps order 2 for any Jacobian (Verwer et al., SIAM J. Sci. Comput. 20, 1999), so derivatives of the bulk modulus
and of the Coriolis terms are left out of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics import (
    dynamics,
    friction,
    hydraulics,
    line_step,
    lines,
    linkage,
    pump,
    terrain,
    terramechanics,
    valve,
)
from edp.sim.physics.jit import inlined

# Side by side, as they are in their file: one a line would be a page.
# isort: off
from edp.sim.physics.scratch import (
    ACROSS, ANCHOR, ANCHOR_COS, ANCHOR_SIN, ANGLES, BRISTLE_K, BYPASS, C_HEAD, C_PUMP_1, C_ROD, CONTACT, F_BY_V,
    F_BY_Z, FROZEN, FROZEN_W, GRAVITY_T, H_BY_1, H_BY_2, H_BY_W, HEAD_BY_1, HEAD_BY_2, HEAD_BY_HEAD, HEAD_K, K1,
    K2, LEVERS, LOST_1, LU, MASS, OPENED, PER_HEAD, PER_ROD, PORT_H_BY_W, PORT_HEAD_K, PORT_ROD_K, PUMP_ROW,
    R_BY_1, R_BY_2, R_BY_W, RATES, RHS, ROD_BY_1, ROD_BY_2, ROD_BY_ROD, ROD_K, SINES, SLOPE, SLOPES, STAGE,
    STROKES_W, T_HH, T_HR, T_RH, T_RR, Z_BY_V, Z_BY_W, Z_BY_Z, Z_LEFT,
)  # fmt: skip
# isort: on

Array = NDArray[np.float64]
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""One of the two values at which ROS2 is L-stable; the other, 1 + 1/sqrt(2), has the larger error constant."""

ANCHORED = 0.03
"""Turn (rad) from its anchor up to which the series of `turned` are exact to rounding."""


@inlined
def anchor(i: int, angle: float, s: Array) -> None:
    """Take cosine and sine of joint `i` here, for `turned`."""
    s[ANCHOR + i], s[ANCHOR_COS + i], s[ANCHOR_SIN + i] = angle, math.cos(angle), math.sin(angle)


@inlined
def turned(i: int, angle: float, s: Array) -> tuple[float, float]:
    """Cosine and sine of joint `i`, by series for the turn since its anchor: within a sample it is small."""
    if not abs(angle - s[ANCHOR + i]) < ANCHORED:
        anchor(i, angle, s)
    x = angle - s[ANCHOR + i]
    q = x * x
    # First terms left out at 0.03 rad: x^8 / 8! = 2e-17 and x^9 / 9! = 5e-20.
    c = 1.0 - q * (1.0 / 2.0 - q * (1.0 / 24.0 - q * (1.0 / 720.0)))
    d = x * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0))))
    return s[ANCHOR_COS + i] * c - s[ANCHOR_SIN + i] * d, s[ANCHOR_SIN + i] * c + s[ANCHOR_COS + i] * d


@inlined
def freeze_geometry(state: Array, axes: Array, plant: Array, strokes: Array, s: Array) -> None:
    """Strokes, lever arms, volumes, mass matrix, gravity and Coriolis coefficients at the current angles."""
    c1, s1 = turned(0, state[at.PSI], s)
    c2, s2 = turned(1, state[at.PSI + 1], s)
    c3, s3 = turned(2, state[at.PSI + 2], s)
    length, s[LEVERS] = linkage.cylinder_at(0, c1, s1, plant)
    strokes[0] = length - axes[0, at.CLOSED]
    length, s[LEVERS + 1] = linkage.cylinder_at(1, c2, s2, plant)
    strokes[1] = length - axes[1, at.CLOSED]
    length, s[LEVERS + 2] = linkage.cylinder_at(2, c3, s3, plant)
    strokes[2] = length - axes[2, at.CLOSED]
    for i in range(at.AXES):
        # Volumes as reciprocals: both stages of a step multiply by them.
        s[PER_HEAD + i] = 1.0 / (axes[i, at.HEAD_DEAD] + axes[i, at.HEAD_AREA] * strokes[i])
        s[PER_ROD + i] = 1.0 / (axes[i, at.ROD_DEAD] + axes[i, at.ROD_AREA] * (axes[i, at.STROKE] - strokes[i]))
    ca, sa = c1 * c2 - s1 * s2, s1 * c2 + c1 * s2
    cb, sb = ca * c3 - sa * s3, sa * c3 + ca * s3
    s[ANGLES], s[ANGLES + 1], s[ANGLES + 2], s[ANGLES + 3], s[ANGLES + 4], s[ANGLES + 5] = c1, s1, ca, sa, cb, sb
    g = dynamics.gravity_terms((c1, s1), (ca, sa), (cb, sb), axes, plant[at.GRAVITY])
    s[GRAVITY_T], s[GRAVITY_T + 1], s[GRAVITY_T + 2] = g
    c12, s12, c13, s13, c23, s23 = dynamics.couplings(c2, s2, c3, s3, axes)
    s[SINES], s[SINES + 1], s[SINES + 2] = s12, s13, s23
    m = dynamics.mass_terms(c12, c13, c23, axes)
    s[MASS], s[MASS + 1], s[MASS + 2], s[MASS + 3], s[MASS + 4], s[MASS + 5] = m


@inlined
def rates(w: Array, axes: Array, plant: Array, work: tuple[Array, ...], jacobian: bool) -> None:
    """F(w) into `work[RATES]`: torque balance (not yet divided by M), pressure and bristle rates.

    `w` is a state vector; its part from RATE to BRISTLE is used, and that of the lines where there are any. Derivatives
    go to `work[SLOPE]` if asked for.
    """
    s, strokes, opened, e, out = work[FROZEN_W], work[STROKES_W], work[OPENED], work[SLOPE], work[RATES]
    w1, w2, w3, pump_1, pump_2 = w[at.RATE], w[at.RATE + 1], w[at.RATE + 2], w[at.PUMP], w[at.PUMP + 1]
    bias = dynamics.coriolis_terms(s[SINES], s[SINES + 1], s[SINES + 2], w1, w2, w3)
    out[at.RATE], out[at.RATE + 1], out[at.RATE + 2] = -bias[0], -bias[1], -bias[2]
    if work[CONTACT][terramechanics.ON] > 0.0:
        soil = terramechanics.torques(work[CONTACT], w1, w2, w3)
        out[at.RATE] += soil[0]
        out[at.RATE + 1] += soil[1]
        out[at.RATE + 2] += soil[2]
    # Parallel orifices see their own load only: no section may find a higher pressure here.
    highest = loads = (-1e9, -1e9)
    if plant[at.COMPENSATED] > 0.0 or plant[at.LOAD_MARGIN] > 0.0:
        loads = (hydraulics.highest_load(0, w, opened, plant), hydraulics.highest_load(1, w, opened, plant))
    if plant[at.COMPENSATED] > 0.0:
        highest = loads
    long, port = plant[at.LINES] > 0.0, lines.at_valve(plant)
    drawn_1 = drawn_2 = 0.0
    for i in range(at.AXES):
        head, rod, v = w[at.HEAD + i], w[at.ROD + i], s[LEVERS + i] * w[at.RATE + i]
        ends = (w[port + i], w[port + at.AXES + i], pump_1, pump_2)
        q, by = hydraulics.cylinder_flows(i, ends, highest, opened, axes, plant)
        drawn_1 += q[2]
        drawn_2 += q[3]
        c_head = hydraulics.stiffness(head, plant) * s[PER_HEAD + i]
        c_rod = hydraulics.stiffness(rod, plant) * s[PER_ROD + i]
        if long:
            c_head, c_rod = line_step.line_rates(i, v, q, w, axes, plant, work)
        else:
            out[at.HEAD + i] = c_head * (q[0] - axes[i, at.HEAD_AREA] * v)
            out[at.ROD + i] = c_rod * (q[1] + axes[i, at.ROD_AREA] * v)
        viscous = axes[i, at.VISCOUS] * plant[at.VISCOUS_SHARE]
        drag, z_rate, f_by_z, f_by_v, z_by_z, z_by_v = friction.lugre(v, w[at.BRISTLE + i], axes, i, viscous)
        stop, stop_by_v = friction.end_stop(strokes[i], v, axes, i)
        out[at.BRISTLE + i] = z_rate
        force = axes[i, at.HEAD_AREA] * head - axes[i, at.ROD_AREA] * rod - drag + stop
        out[at.RATE + i] += s[LEVERS + i] * force - s[GRAVITY_T + i]
        if jacobian:
            e[i, C_HEAD], e[i, C_ROD] = c_head, c_rod
            e[i, HEAD_BY_HEAD], e[i, ROD_BY_ROD], e[i, ACROSS] = by[0], by[1], by[2]
            e[i, HEAD_BY_1], e[i, HEAD_BY_2], e[i, ROD_BY_1], e[i, ROD_BY_2] = by[3], by[4], by[5], by[6]
            # The force holds -drag + stop, so that the derivative of the stop enters the drag's with the other sign.
            e[i, F_BY_Z], e[i, F_BY_V], e[i, Z_BY_Z], e[i, Z_BY_V] = f_by_z, f_by_v - stop_by_v, z_by_z, z_by_v
    for m in range(2):
        p = w[at.PUMP + m]
        relief = hydraulics.relief_of(loads[m], plant)
        lost, lost_slope = hydraulics.pump_outflow(p, s[BYPASS + m], relief, plant)
        supply = plant[at.EFFICIENCY + m] * plant[at.MAX_FLOW] * w[at.DISPLACEMENT + m]
        c_pump = hydraulics.stiffness(p, plant) / plant[at.LINE_VOLUME]
        out[at.PUMP + m] = c_pump * (supply - lost - (drawn_1 if m == 0 else drawn_2))
        if jacobian:
            e[PUMP_ROW, LOST_1 + m], e[PUMP_ROW, C_PUMP_1 + m] = lost_slope, c_pump


@inlined
def eliminate(g: float, axes: Array, s: Array, e: Array) -> None:
    """Chamber pressures and bristles as linear functions of joint rates and pump pressures, into the slopes `e`."""
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
def factorise(g: float, axes: Array, long: bool, work: tuple[Array, ...]) -> None:
    """Factor what is left of I - g J, 5x5, into `work[LU]`; no pivoting, its diagonal dominates.

    `long` says whether lines lie between valves and chambers.
    """
    s, lu, e, contact = work[FROZEN_W], work[LU], work[SLOPE], work[CONTACT]
    # The pumps feel what the sections see: the chambers, or the lines' ends at the valve.
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
def solve(g: float, axes: Array, long: bool, work: tuple[Array, ...], out: Array) -> None:
    """Solve (I - g J) k = work[RHS] (rows of the joint rates multiplied by M); k goes to `out`, laid out as a state.

    `long` says whether lines lie between valves and chambers.
    """
    s, lu, e, r = work[FROZEN_W], work[LU], work[SLOPE], work[RHS]
    b3, b4 = r[at.PUMP], r[at.PUMP + 1]
    gc_1, gc_2 = g * e[PUMP_ROW, C_PUMP_1], g * e[PUMP_ROW, C_PUMP_1 + 1]
    for i in range(at.AXES):
        if long:
            head, rod = line_step.known_lines(i, g, r, e)
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


@inlined
def rosenbrock(state: Array, h: float, axes: Array, plant: Array, work: tuple[Array, ...]) -> None:
    """ROS2 on w: (I - gJ) k1 = F(w), (I - gJ) k2 = F(w + h k1) - 2 k1, w += 1.5 h k1 + 0.5 h k2, g = gamma h."""
    s, rhs, f, k1, k2, stage = work[FROZEN_W], work[RHS], work[RATES], work[K1], work[K2], work[STAGE]
    g, long = GAMMA * h, plant[at.LINES] > 0.0
    rates(state, axes, plant, work, True)
    factorise(g, axes, long, work)
    for n in range(at.RATE, at.DISPLACEMENT):
        rhs[n] = f[n]
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            rhs[n] = f[n]
    solve(g, axes, long, work, k1)
    for n in range(at.RATE, at.DISPLACEMENT):
        stage[n] = state[n] + h * k1[n]
    # Displacements have exact half steps of their own and are constant for ROS2.
    for m in range(2):
        stage[at.DISPLACEMENT + m] = state[at.DISPLACEMENT + m]
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            stage[n] = state[n] + h * k1[n]
    rates(stage, axes, plant, work, False)
    for n in range(at.HEAD, at.DISPLACEMENT):
        rhs[n] = f[n] - 2.0 * k1[n]
    # The left-hand side of these rows holds M instead of I, so 2 k1 is multiplied by M as well.
    a, b, c = 2.0 * k1[at.RATE], 2.0 * k1[at.RATE + 1], 2.0 * k1[at.RATE + 2]
    rhs[at.RATE] = f[at.RATE] - s[MASS] * a - s[MASS + 1] * b - s[MASS + 2] * c
    rhs[at.RATE + 1] = f[at.RATE + 1] - s[MASS + 1] * a - s[MASS + 3] * b - s[MASS + 4] * c
    rhs[at.RATE + 2] = f[at.RATE + 2] - s[MASS + 2] * a - s[MASS + 4] * b - s[MASS + 5] * c
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            rhs[n] = f[n] - 2.0 * k1[n]
    solve(g, axes, long, work, k2)
    for n in range(at.RATE, at.DISPLACEMENT):
        state[n] += h * (1.5 * k1[n] + 0.5 * k2[n])
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            state[n] += h * (1.5 * k1[n] + 0.5 * k2[n])


@inlined
def begin_sample(state: Array, work: tuple[Array, ...]) -> None:
    """Anchor the joints, so that no step depends on more than the state at the beginning of its sample."""
    for i in range(at.AXES):
        anchor(i, state[at.PSI + i], work[FROZEN_W])


@inlined
def clamp_pressures(state: Array, long: bool) -> int:
    """Lift pressures below 0.1 bar absolute to it, in lines, too, where they are `long`; returns how many."""
    lifted = 0
    if long:
        for n in range(at.PORT_HEAD, at.FLOW_HEAD):
            if state[n] < at.LOWEST_PRESSURE:
                state[n] = at.LOWEST_PRESSURE
                lifted += 1
    for n in range(at.HEAD, at.BRISTLE):
        if state[n] < at.LOWEST_PRESSURE:
            state[n] = at.LOWEST_PRESSURE
            lifted += 1
    return lifted


@inlined
def step(
    state: Array,
    valves: Array,
    demand: Array,
    clock: tuple[float, float, Array],
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    near_soil: bool,
) -> int:
    """Advance plant and spools by one step with the spool demands held; returns the number of clamped pressures.

    Args:
        state: plant state.
        valves: pilots, play and spools.
        demand: of each spool, shape (6,).
        clock: step length (s), displacement share and filters of half a step.
        setup: axes, plant, work, and the arrays of the ground.
        near_soil: whether the bucket may touch the ground within this step.
    """
    h, share, filters = clock
    axes, plant, work, ground = setup
    # Half steps before and after ROS2 in mirrored order: Strang splitting has order 2 only if it is symmetric.
    valve.pilot_half_step(demand, filters, axes, valves)
    valve.spool_half_step(filters, valves)
    pump.displacement_step(state, valves, axes, plant, share)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    # Mid-step: geometry frozen at either end would lower the order to one.
    freeze_geometry(state, axes, plant, work[STROKES_W], work[FROZEN_W])
    valve.open_spools(valves, work[STROKES_W], axes, work[OPENED])
    bypass = pump.bypass_conductances(valves, axes, plant)
    work[FROZEN_W][BYPASS], work[FROZEN_W][BYPASS + 1] = bypass
    # Contact of the step before must not act on a bucket that has left the ground.
    work[CONTACT][terramechanics.ON] = 0.0
    if near_soil:
        terramechanics.engage(state, work[FROZEN_W][ANGLES:], axes, ground, work[CONTACT])
    rosenbrock(state, h, axes, plant, work)
    if near_soil:
        terrain.settle(state, h, work[CONTACT], ground)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    pump.displacement_step(state, valves, axes, plant, share)
    valve.spool_half_step(filters, valves)
    valve.pilot_half_step(demand, filters, axes, valves)
    # Last: within a step the stages may pass below vacuum, and a clamp there would break the order.
    return clamp_pressures(state, plant[at.LINES] > 0.0)


def new_work() -> tuple[Array, ...]:
    """Fresh scratch arrays for `step`."""
    shapes: list[tuple[int, ...]] = [(FROZEN,), (3,), (3, at.OPENINGS), (5, 5), (4, SLOPES), (terramechanics.CONTACTS,)]
    return tuple(np.zeros(shape) for shape in shapes + [(at.STATES,)] * 5)


def clock_of(machine: Machine, step_s: float) -> tuple[float, float, Array]:
    """What `step` needs for one step length."""
    half = 0.5 * step_s
    return step_s, pump.displacement_share(machine.pumps.time_constant, half), valve.spool_filters(machine, half)
