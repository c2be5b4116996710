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
from edp.sim.physics import motors as places
from edp.sim.physics.equations import factorise, solve
from edp.sim.physics.jit import inlined
from edp.sim.physics.motors import Motors

# One name per line would fill a page, so the names stay side by side.
# isort: off
from edp.sim.physics.scratch import (
    MovingParts,
    ACROSS, ANCHOR, ANCHOR_COS, ANCHOR_SIN, ANGLES, BYPASS, C_HEAD, C_PUMP_1, C_ROD, CONTACT, F_BY_V, F_BY_Z, FROZEN,
    FROZEN_W, GRAVITY_T, HEAD_BY_1, HEAD_BY_2, HEAD_BY_HEAD, K1, K2, LEVERS, LOST_1, MASS, OPENED, PER_HEAD, PER_ROD,
    PUMP_ROW, RATES, RHS, ROD_BY_1, ROD_BY_2, ROD_BY_ROD, SINES, SLOPE, SLOPES, STAGE, STROKES_W, Z_BY_V, Z_BY_Z,
)  # fmt: skip
# isort: on

Array = NDArray[np.float64]
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Coefficient of the ROS2 method with L-stability. The other L-stable value, 1 + 1/sqrt(2), has the larger error
constant."""

ANCHORED = 0.03
"""Maximum rotation (rad) from the anchor for which the series of `turned` are exact to rounding."""


@inlined
def anchor(i: int, angle: float, s: Array) -> None:
    """Take cosine and sine of joint `i` here, for `turned`."""
    s[ANCHOR + i], s[ANCHOR_COS + i], s[ANCHOR_SIN + i] = angle, math.cos(angle), math.sin(angle)


@inlined
def turned(i: int, angle: float, s: Array) -> tuple[float, float]:
    """Return the cosine and sine of joint `i`, by series for the turn since its anchor: within a sample it is small."""
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
    """Compute strokes, lever arms, volumes, mass matrix, gravity and Coriolis terms at the current angles."""
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
def section_loads(w: Array, opened: Array, plant: Array, jacobian: bool, motors: Motors | None) -> tuple[float, float]:
    """Return the largest pressure (Pa) connected to each pump."""
    first, second = hydraulics.highest_load(0, w, opened, plant), hydraulics.highest_load(1, w, opened, plant)
    if motors is not None:
        turning = places.present(motors, jacobian)
        first = max(first, places.highest_load(0, turning, motors))
        second = max(second, places.highest_load(1, turning, motors))
    return first, second


@inlined
def rates(w: Array, axes: Array, plant: Array, work: tuple[Array, ...], jacobian: bool, motors: Motors | None) -> None:
    """Write F(w) to `work[RATES]`: torque balance (not yet divided by M), pressure and bristle rates.

    `w` is a state vector, of which the part from RATE to BRISTLE and the part of the lines are used. Derivatives are
    written to `work[SLOPE]` if requested; the motors are then at their own state, otherwise at that of the stage.
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
        loads = section_loads(w, opened, plant, jacobian, motors)
    if plant[at.COMPENSATED] > 0.0:
        highest = loads
    long, port = plant[at.LINES] > 0.0, lines.first_valve_pressure(plant)
    drawn_1 = drawn_2 = 0.0
    if motors is not None:
        drawn_1, drawn_2 = places.rates((w1, w2, w3), (pump_1, pump_2, *highest), motors, plant, jacobian, out)
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
def rosenbrock(
    state: Array, h: float, axes: Array, plant: Array, work: tuple[Array, ...], motors: Motors | None
) -> None:
    """Advance w by one step of ROS2.

    (I - gJ) k1 = F(w), (I - gJ) k2 = F(w + h k1) - 2 k1, w += 1.5 h k1 + 0.5 h k2, g = gamma h.
    """
    s, rhs, f, k1, k2, stage = work[FROZEN_W], work[RHS], work[RATES], work[K1], work[K2], work[STAGE]
    g, long = GAMMA * h, plant[at.LINES] > 0.0
    rates(state, axes, plant, work, True, motors)
    factorise(g, axes, long, work, motors)
    if motors is not None:
        places.first_stage(motors)
    for n in range(at.RATE, at.DISPLACEMENT):
        rhs[n] = f[n]
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            rhs[n] = f[n]
    solve(g, axes, long, work, k1, motors)
    for n in range(at.RATE, at.DISPLACEMENT):
        stage[n] = state[n] + h * k1[n]
    # Displacements have exact half steps of their own and are constant for ROS2.
    for m in range(2):
        stage[at.DISPLACEMENT + m] = state[at.DISPLACEMENT + m]
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            stage[n] = state[n] + h * k1[n]
    if motors is not None:
        places.to_stage(motors, h)
    rates(stage, axes, plant, work, False, motors)
    if motors is not None:
        places.second_stage(motors)
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
    solve(g, axes, long, work, k2, motors)
    if motors is not None:
        places.finish(motors, h)
    for n in range(at.RATE, at.DISPLACEMENT):
        state[n] += h * (1.5 * k1[n] + 0.5 * k2[n])
    if long:
        for n in range(at.PORT_HEAD, at.STATES):
            state[n] += h * (1.5 * k1[n] + 0.5 * k2[n])


@inlined
def begin_sample(state: Array, work: tuple[Array, ...]) -> None:
    """Reset the joints' reference angles, so that a step depends only on the state at the start of its sample."""
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
    moving: MovingParts,
    demand: Array,
    clock: tuple[float, float, Array],
    setup: tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]],
    near_soil: bool,
    motors: Motors | None = None,
    fine: bool = False,
) -> int:
    """Advance plant and spools by one step with the spool demands held; returns the number of clamped pressures.

    Args:
        moving: state of the plant and its valves; moved.
        demand: demand of each spool, shape (6,).
        clock: step length (s), displacement share and filters of half a step.
        setup: axes, plant, work, and the arrays of the ground.
        near_soil: whether the bucket may touch the ground within this step.
        motors: swing and travel, where they move.
        fine: whether the step is a fine one of theirs.
    """
    (state, valves), (h, share, filters) = moving, clock
    axes, plant, work, ground = setup
    # Half steps before and after ROS2 in mirrored order: Strang splitting has order 2 only if it is symmetric.
    valve.pilot_half_step(demand, filters, axes, valves)
    valve.spool_half_step(filters, valves)
    if motors is not None:
        places.pilot_half_step(motors, fine, axes[0, at.HYSTERESIS])
        places.spool_half_step(motors, fine)
        places.advance(motors, 0.5 * h)
    pump.displacement_step(state, valves, axes, plant, share, motors)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    # Mid-step: geometry frozen at either end would lower the order to one.
    freeze_geometry(state, axes, plant, work[STROKES_W], work[FROZEN_W])
    valve.open_spools(valves, work[STROKES_W], axes, work[OPENED])
    if motors is not None:
        places.open_sections(motors)
        places.freeze_inertia(motors, work[FROZEN_W][ANGLES:], axes)
    bypass = pump.bypass_conductances(valves, axes, plant, motors)
    work[FROZEN_W][BYPASS], work[FROZEN_W][BYPASS + 1] = bypass
    # Contact of the step before must not act on a bucket that has left the ground.
    work[CONTACT][terramechanics.ON] = 0.0
    if near_soil:
        terramechanics.engage(state, work[FROZEN_W][ANGLES:], axes, ground, work[CONTACT])
    rosenbrock(state, h, axes, plant, work, motors)
    if near_soil:
        terrain.settle(state, h, work[CONTACT], ground)
    for i in range(at.AXES):
        state[at.PSI + i] += 0.5 * h * state[at.RATE + i]
    pump.displacement_step(state, valves, axes, plant, share, motors)
    valve.spool_half_step(filters, valves)
    valve.pilot_half_step(demand, filters, axes, valves)
    # Clamp at the end of a step. Stages may pass below vacuum, and a clamp there would reduce the order.
    lifted = clamp_pressures(state, plant[at.LINES] > 0.0)
    if motors is not None:
        places.advance(motors, 0.5 * h)
        places.spool_half_step(motors, fine)
        places.pilot_half_step(motors, fine, axes[0, at.HYSTERESIS])
        lifted += places.settle(motors, h)
    return lifted


def new_work() -> tuple[Array, ...]:
    """Return the fresh scratch arrays for `step`."""
    shapes: list[tuple[int, ...]] = [(FROZEN,), (3,), (3, at.OPENINGS), (5, 5), (4, SLOPES), (terramechanics.CONTACTS,)]
    return tuple(np.zeros(shape) for shape in shapes + [(at.STATES,)] * 5)


def clock_of(machine: Machine, step_s: float) -> tuple[float, float, Array]:
    """Return the arguments of `step` for one step length."""
    half = 0.5 * step_s
    return step_s, pump.displacement_share(machine.pumps.time_constant, half), valve.spool_filters(machine, half)
