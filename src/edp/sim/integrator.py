"""One step of the plant: Strang splitting around a two-stage, L-stable Rosenbrock method (ROS2).

Within a step the geometry, the mass matrix and the spools are frozen at mid-step; ROS2 advances
w = (psi', p_head, p_rod, p_pump, z). Chamber pressures and bristles are eliminated in closed form, which leaves
three joint rates and two pump pressures. ROS2 keeps order 2 for any Jacobian (Verwer et al., SIAM J. Sci. Comput.
20, 1999), so derivatives of the bulk modulus and of the Coriolis terms are left out of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import dynamics, friction, hydraulics, linkage, pump, valve
from edp.sim import layout as at
from edp.sim.jit import compiled
from edp.sim.machine import Machine

Array = NDArray[np.float64]
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)

# s[...]: scratch, one vector of up to STATES values each; EXTERNAL is a joint torque from outside (soil)
(
    STROKES, LEVERS, COUPLING, GRAVITY_T, BIAS, BYPASS, EXTERNAL, RATES, RHS, K1, K2, STAGE, HEAD_K, ROD_K, BRISTLE_K,
    FORCING,
) = range(16)  # fmt: skip
SCRATCH = (16, at.STATES)
# slopes[cylinder, ...]: Jacobian pieces and elimination factors of one cylinder
(
    C_HEAD, C_ROD, T_HH, T_HR, T_RH, T_RR, H_BY_W, H_BY_1, H_BY_2, R_BY_W, R_BY_1, R_BY_2, Z_BY_W, Z_LEFT,
    F_BY_Z, F_BY_V, Z_BY_V, Z_BY_Z,
) = range(18)  # fmt: skip
SLOPES = 18
# slopes[PUMP_ROW, ...]: slope of the flow lost from each pump line, then stiffness over volume
PUMP_ROW, LOST_1, C_PUMP_1 = 3, 0, 2
# work: scratch, openings, mass matrix, LU factors, flows and slopes of stage 1, flows and slopes of stage 2
S, OPENED, MASS, LU, FLOW, SLOPE, FLOW_2, SLOPE_2 = range(8)


@compiled
def freeze_geometry(state: Array, axes: Array, plant: Array, mass: Array, s: Array) -> None:
    """Strokes, lever arms, mass matrix, gravity and Coriolis coefficients at the current angles."""
    psi = state[at.PSI : at.PSI + 3]
    for i in range(at.AXES):
        length, lever = linkage.cylinder(i, psi[i], plant)
        s[STROKES, i] = length - axes[i, at.CLOSED]
        s[LEVERS, i] = lever
    dynamics.mass_matrix(psi, axes, mass)
    dynamics.gravity_torque(psi, axes, plant[at.GRAVITY], s[GRAVITY_T])
    terms = dynamics.couplings(psi, axes)
    for n in range(6):
        s[COUPLING, n] = terms[n]


@compiled
def rates(w: Array, opened: Array, axes: Array, plant: Array, flow: Array, s: Array, slopes: Array) -> None:
    """F(w) into `s[RATES]`: torque balance (not yet divided by M), pressure and bristle rates.

    `w` is a state vector; only its part from RATE to BRISTLE is used. Derivatives go to `flow` and `slopes`.
    """
    out = s[RATES]
    c = s[COUPLING]
    dynamics.coriolis_torque((c[0], c[1], c[2], c[3], c[4], c[5]), w[at.RATE : at.RATE + 3], s[BIAS])
    drawn_1 = drawn_2 = 0.0
    for i in range(at.AXES):
        a, lever = axes[i], s[LEVERS, i]
        v = lever * w[at.RATE + i]
        hydraulics.cylinder_flows(i, w, opened, axes, plant, flow)
        drawn_1 += flow[i, at.DRAWN_1]
        drawn_2 += flow[i, at.DRAWN_2]
        volume = a[at.HEAD_DEAD] + a[at.HEAD_AREA] * s[STROKES, i]
        slopes[i, C_HEAD] = hydraulics.stiffness(w[at.HEAD + i], plant) / volume
        volume = a[at.ROD_DEAD] + a[at.ROD_AREA] * (a[at.STROKE] - s[STROKES, i])
        slopes[i, C_ROD] = hydraulics.stiffness(w[at.ROD + i], plant) / volume
        out[at.HEAD + i] = slopes[i, C_HEAD] * (flow[i, at.Q_HEAD] - a[at.HEAD_AREA] * v)
        out[at.ROD + i] = slopes[i, C_ROD] * (flow[i, at.Q_ROD] + a[at.ROD_AREA] * v)
        drag, z_rate, f_by_z, f_by_v, z_by_z, z_by_v = friction.lugre(v, w[at.BRISTLE + i], a)
        stop, stop_by_v = friction.end_stop(s[STROKES, i], v, a)
        slopes[i, F_BY_Z], slopes[i, F_BY_V] = f_by_z, f_by_v - stop_by_v
        slopes[i, Z_BY_Z], slopes[i, Z_BY_V] = z_by_z, z_by_v
        out[at.BRISTLE + i] = z_rate
        force = a[at.HEAD_AREA] * w[at.HEAD + i] - a[at.ROD_AREA] * w[at.ROD + i] - drag + stop
        out[at.RATE + i] = lever * force + s[EXTERNAL, i] - s[BIAS, i] - s[GRAVITY_T, i]
    for m in range(2):
        p = w[at.PUMP + m]
        lost, lost_slope = hydraulics.pump_outflow(p, s[BYPASS, m], plant)
        supply = plant[at.EFFICIENCY] * plant[at.MAX_FLOW] * w[at.DISPLACEMENT + m]
        c_pump = hydraulics.stiffness(p, plant) / plant[at.LINE_VOLUME]
        out[at.PUMP + m] = c_pump * (supply - lost - (drawn_1 if m == 0 else drawn_2))
        slopes[PUMP_ROW, LOST_1 + m] = lost_slope
        slopes[PUMP_ROW, C_PUMP_1 + m] = c_pump


@compiled
def eliminate(g: float, axes: Array, flow: Array, s: Array, slopes: Array) -> None:
    """Chamber pressures and bristles as linear functions of joint rates and pump pressures, into `slopes`."""
    for i in range(at.AXES):
        f, e, a, lever = flow[i], slopes[i], axes[i], s[LEVERS, i]
        ch, cr = g * e[C_HEAD], g * e[C_ROD]
        hh, hr = 1.0 - ch * f[at.HEAD_BY_HEAD], -ch * f[at.HEAD_BY_ROD]
        rh, rr = -cr * f[at.ROD_BY_HEAD], 1.0 - cr * f[at.ROD_BY_ROD]
        det = 1.0 / (hh * rr - hr * rh)
        e[T_HH], e[T_HR], e[T_RH], e[T_RR] = rr * det, -hr * det, -rh * det, hh * det
        by_w_head, by_w_rod = -ch * a[at.HEAD_AREA] * lever, cr * a[at.ROD_AREA] * lever
        e[H_BY_W] = e[T_HH] * by_w_head + e[T_HR] * by_w_rod
        e[R_BY_W] = e[T_RH] * by_w_head + e[T_RR] * by_w_rod
        for m in range(2):
            head, rod = ch * f[at.HEAD_BY_1 + m], cr * f[at.ROD_BY_1 + m]
            e[H_BY_1 + m] = e[T_HH] * head + e[T_HR] * rod
            e[R_BY_1 + m] = e[T_RH] * head + e[T_RR] * rod
        e[Z_LEFT] = 1.0 / (1.0 - g * e[Z_BY_Z])
        e[Z_BY_W] = g * e[Z_BY_V] * lever * e[Z_LEFT]


@compiled
def factorise(g: float, axes: Array, work: tuple[Array, ...]) -> None:
    """Factor what is left of I - g J, 5x5, into `work[LU]`; no pivoting, its diagonal dominates."""
    s, mass, lu, flow, slopes = work[S], work[MASS], work[LU], work[FLOW], work[SLOPE]
    eliminate(g, axes, flow, s, slopes)
    p = slopes[PUMP_ROW]
    for i in range(3):
        for j in range(3):
            lu[i, j] = mass[i, j]
        lu[i, 3] = lu[i, 4] = lu[3, i] = lu[4, i] = 0.0
    lu[3, 4] = lu[4, 3] = 0.0
    lu[3, 3] = 1.0 + g * p[C_PUMP_1] * p[LOST_1]
    lu[4, 4] = 1.0 + g * p[C_PUMP_1 + 1] * p[LOST_1 + 1]
    for i in range(at.AXES):
        f, e, a, arm = flow[i], slopes[i], axes[i], g * s[LEVERS, i]
        force_by_w = a[at.HEAD_AREA] * e[H_BY_W] - a[at.ROD_AREA] * e[R_BY_W]
        lu[i, i] -= arm * (force_by_w - e[F_BY_Z] * e[Z_BY_W] - e[F_BY_V] * s[LEVERS, i])
        for m in range(2):
            lu[i, 3 + m] -= arm * (a[at.HEAD_AREA] * e[H_BY_1 + m] - a[at.ROD_AREA] * e[R_BY_1 + m])
            gc, by_head, by_rod = g * p[C_PUMP_1 + m], f[at.HEAD_BY_1 + m], f[at.ROD_BY_1 + m]
            lu[3 + m, 3 + m] += gc * (by_head + by_rod)
            lu[3 + m, i] -= gc * (by_head * e[H_BY_W] + by_rod * e[R_BY_W])
            for n in range(2):
                lu[3 + m, 3 + n] -= gc * (by_head * e[H_BY_1 + n] + by_rod * e[R_BY_1 + n])
    for k in range(4):
        inverse = 1.0 / lu[k, k]
        for i in range(k + 1, 5):
            lu[i, k] *= inverse
            for j in range(k + 1, 5):
                lu[i, j] -= lu[i, k] * lu[k, j]


@compiled
def solve(g: float, axes: Array, work: tuple[Array, ...], out: Array) -> None:
    """Solve (I - g J) k = s[RHS] (rows of the joint rates multiplied by M); k goes to `out`, laid out as a state."""
    s, lu, flow, slopes = work[S], work[LU], work[FLOW], work[SLOPE]
    r, p = s[RHS], slopes[PUMP_ROW]
    b0, b1, b2, b3, b4 = r[at.RATE], r[at.RATE + 1], r[at.RATE + 2], r[at.PUMP], r[at.PUMP + 1]
    head, rod, z, forcing = s[HEAD_K], s[ROD_K], s[BRISTLE_K], s[FORCING]
    for i in range(at.AXES):
        e, a, f = slopes[i], axes[i], flow[i]
        head[i] = e[T_HH] * r[at.HEAD + i] + e[T_HR] * r[at.ROD + i]
        rod[i] = e[T_RH] * r[at.HEAD + i] + e[T_RR] * r[at.ROD + i]
        z[i] = r[at.BRISTLE + i] * e[Z_LEFT]
        forcing[i] = g * s[LEVERS, i] * (a[at.HEAD_AREA] * head[i] - a[at.ROD_AREA] * rod[i] - e[F_BY_Z] * z[i])
        b3 += g * p[C_PUMP_1] * (f[at.HEAD_BY_1] * head[i] + f[at.ROD_BY_1] * rod[i])
        b4 += g * p[C_PUMP_1 + 1] * (f[at.HEAD_BY_2] * head[i] + f[at.ROD_BY_2] * rod[i])
    b0, b1, b2 = b0 + forcing[0], b1 + forcing[1], b2 + forcing[2]
    b1 -= lu[1, 0] * b0
    b2 -= lu[2, 0] * b0 + lu[2, 1] * b1
    b3 -= lu[3, 0] * b0 + lu[3, 1] * b1 + lu[3, 2] * b2
    b4 -= lu[4, 0] * b0 + lu[4, 1] * b1 + lu[4, 2] * b2 + lu[4, 3] * b3
    b4 /= lu[4, 4]
    b3 = (b3 - lu[3, 4] * b4) / lu[3, 3]
    b2 = (b2 - lu[2, 3] * b3 - lu[2, 4] * b4) / lu[2, 2]
    b1 = (b1 - lu[1, 2] * b2 - lu[1, 3] * b3 - lu[1, 4] * b4) / lu[1, 1]
    b0 = (b0 - lu[0, 1] * b1 - lu[0, 2] * b2 - lu[0, 3] * b3 - lu[0, 4] * b4) / lu[0, 0]
    out[at.RATE], out[at.RATE + 1], out[at.RATE + 2], out[at.PUMP], out[at.PUMP + 1] = b0, b1, b2, b3, b4
    for i in range(at.AXES):
        e, k = slopes[i], out[at.RATE + i]
        out[at.HEAD + i] = head[i] + e[H_BY_W] * k + e[H_BY_1] * b3 + e[H_BY_2] * b4
        out[at.ROD + i] = rod[i] + e[R_BY_W] * k + e[R_BY_1] * b3 + e[R_BY_2] * b4
        out[at.BRISTLE + i] = z[i] + e[Z_BY_W] * k


@compiled
def rosenbrock(state: Array, h: float, axes: Array, plant: Array, work: tuple[Array, ...]) -> None:
    """ROS2 on w: (I - gJ) k1 = F(w), (I - gJ) k2 = F(w + h k1) - 2 k1, w += 1.5 h k1 + 0.5 h k2, g = gamma h."""
    s, mass = work[S], work[MASS]
    g = GAMMA * h
    k1, k2, stage, rhs, f = s[K1], s[K2], s[STAGE], s[RHS], s[RATES]
    rates(state, work[OPENED], axes, plant, work[FLOW], s, work[SLOPE])
    factorise(g, axes, work)
    for n in range(at.RATE, at.DISPLACEMENT):
        rhs[n] = f[n]
    solve(g, axes, work, k1)
    for n in range(at.RATE, at.DISPLACEMENT):
        stage[n] = state[n] + h * k1[n]
    for m in range(2):
        stage[at.DISPLACEMENT + m] = state[at.DISPLACEMENT + m]
    rates(stage, work[OPENED], axes, plant, work[FLOW_2], s, work[SLOPE_2])
    for n in range(at.HEAD, at.DISPLACEMENT):
        rhs[n] = f[n] - 2.0 * k1[n]
    for i in range(3):
        momentum = mass[i, 0] * k1[at.RATE] + mass[i, 1] * k1[at.RATE + 1] + mass[i, 2] * k1[at.RATE + 2]
        rhs[at.RATE + i] = f[at.RATE + i] - 2.0 * momentum
    solve(g, axes, work, k2)
    for n in range(at.RATE, at.DISPLACEMENT):
        state[n] += h * (1.5 * k1[n] + 0.5 * k2[n])


@compiled
def clamp_pressures(state: Array) -> int:
    """Lift pressures below 0.1 bar absolute to it; returns how many."""
    lifted = 0
    for n in range(at.HEAD, at.BRISTLE):
        if state[n] < at.LOWEST_PRESSURE:
            state[n] = at.LOWEST_PRESSURE
            lifted += 1
    return lifted


@compiled
def step(
    state: Array, valves: Array, demand: Array, clock: Array, axes: Array, plant: Array, work: tuple[Array, ...]
) -> int:
    """Advance plant and spools by one step with the spool demands held; returns the number of clamped pressures.

    `clock` is one row of `clocks`: step length, displacement share of half a step, then the spool filters.
    """
    h, share, s = clock[0], clock[1], work[S]
    filters = clock[2:].reshape((at.SPOOLS, 2, 4))
    valve.pilot_half_step(demand, filters, plant[at.HYSTERESIS], valves)
    valve.spool_half_step(filters, valves)
    pump.displacement_step(state, valves, axes, plant, share)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    freeze_geometry(state, axes, plant, work[MASS], s)
    valve.open_spools(valves, s[STROKES], axes, work[OPENED])
    for m in range(2):
        s[BYPASS, m] = pump.bypass_conductance(m, valves, axes, plant)
    rosenbrock(state, h, axes, plant, work)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    pump.displacement_step(state, valves, axes, plant, share)
    valve.spool_half_step(filters, valves)
    valve.pilot_half_step(demand, filters, plant[at.HYSTERESIS], valves)
    return clamp_pressures(state)


def new_work() -> tuple[Array, ...]:
    """Fresh scratch arrays for `step`."""
    shapes = [SCRATCH, (3, at.OPENINGS), (3, 3), (5, 5), (3, at.FLOWS), (4, SLOPES), (3, at.FLOWS), (4, SLOPES)]
    return tuple(np.zeros(shape) for shape in shapes)


def clock_row(machine: Machine, step_s: float) -> Array:
    """What `step` needs for one step length, flat."""
    half = 0.5 * step_s
    share = pump.displacement_share(machine.pumps.time_constant, half)
    return np.concatenate(([step_s, share], valve.spool_filters(machine, half).ravel()))
