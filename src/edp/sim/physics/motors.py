"""Swing and travel: hydraulic motors that draw from the same pumps as the cylinders.

A motor (Merritt, Hydraulic Control Systems, 1967) sweeps D for each unit of its motion w, rad/s of the upper structure
or m/s of a track, with ports a and b of the volume V, each with a relief, a make-up check and a drain:

    C(a) a' = Q_a - L (a - b) - D w,   C(b) b' = Q_b + L (a - b) + D w,   J w' = D (a - b) - friction(w) - w dJ/dt

with C = V / beta(p). A section of the main valve lets oil from its pump through a load check into one port and from the
other to tank. Friction is (F_c + brake) w / (w^2 + STILL^2)^(1/2) + F_v w; the parking brake falls in some time
after the spool has closed. The inertia J of the swing is that of the upper structure and of the front at its pose,
J_0 + sum(m X^2 + I cos^2), X from the axis; by Lagrange's equations the joints of the front feel w^2 / 2 dJ/dpsi.
Tracks move half of the machine each, on level ground, and do not move the soil's profile.

Within a step of the integrator each motor is eliminated as a function of its pump's pressure, so that the cylinders
keep their 5 x 5 equations. Functions take `Motors`, a tuple created by `motor_circuit.MotorCircuit`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import hydraulics, valve
from edp.sim.physics.jit import compiled, inlined, pasted

Array = NDArray[np.float64]
Motors = tuple[Array, ...]
STILL = 5e-3
"""Speed (rad/s, m/s) below which dry friction decreases to zero, so that the friction model has no state."""
NEVER = 1e12
"""Opening pressure of a relief valve that never opens, Pa."""

# Motors[...]
(
    NUMBERS, STATE, VALVES, OPENED, FROZEN, SLOPE, RATES, RHS, K1, K2, STAGE, DEMANDS, DELAYS, HELD, COARSE, FINE, LOG,
) = range(17)  # fmt: skip
# OPENED[motor, ...]: from the pump into either port, and from either to tank
IN_A, IN_B, OUT_A, OUT_B = range(4)
# FROZEN[...]: inertia of the swing and its slopes by the joint angles
INERTIA, BY_JOINT = 0, 1
# SLOPE[motor, ...]: Jacobian pieces, and factors of the elimination
(
    C_A, C_B, A_BY_A, B_BY_B, ACROSS, A_BY_P, B_BY_P, DRAG, MOVED,
    T_AA, T_AB, T_BA, T_BB, A_BY_W, B_BY_W, W_LEFT, W_P, A_P, B_P, W_K, A_K, B_K,
) = range(22)  # fmt: skip
SLOPES = 22


@inlined
def pilot_half_step(motors: Motors, fine: bool, hysteresis: float) -> None:
    """Advance the pilots by half a step, a `fine` one or not, towards the commands held, then the play's output."""
    valves, filters = motors[VALVES], motors[FINE] if fine else motors[COARSE]
    for i in range(at.MOTORS):
        valve.relax(valves, i, at.PILOT, motors[HELD][i], filters, 0)
        pilot = valves[i, at.PILOT]
        valves[i, at.PLAY] = max(pilot - hysteresis, min(pilot + hysteresis, valves[i, at.PLAY]))


@inlined
def spool_half_step(motors: Motors, fine: bool) -> None:
    """Advance the spools by half a step, a `fine` one or not."""
    valves, filters = motors[VALVES], motors[FINE] if fine else motors[COARSE]
    for i in range(at.MOTORS):
        valve.relax(valves, i, at.SPOOL, valves[i, at.PLAY], filters, 1)


@inlined
def advance(motors: Motors, half_s: float) -> None:
    """Move on by half a step at the present speeds."""
    for i in range(at.MOTORS):
        motors[STATE][i, at.WAY] += half_s * motors[STATE][i, at.SPEED]


@inlined
def open_sections(motors: Motors) -> None:
    """Compute the openings at the present spool positions."""
    numbers, valves, out = motors[NUMBERS], motors[VALVES], motors[OPENED]
    for i in range(at.MOTORS):
        spool = valves[i, at.SPOOL]
        area = valve.opening(spool, numbers[i, at.MOTOR_DEAD_BAND])
        into, away = numbers[i, at.MOTOR_IN] * area, numbers[i, at.MOTOR_OUT] * area
        forward = spool > 0.0
        out[i, IN_A], out[i, OUT_B] = (into, away) if forward else (0.0, 0.0)
        out[i, IN_B], out[i, OUT_A] = (0.0, 0.0) if forward else (into, away)


@inlined
def freeze_inertia(motors: Motors, turns: Array, axes: Array) -> None:
    """Compute the inertia of the swing and its derivatives from the front's absolute angles in `turns`."""
    frozen, foot = motors[FROZEN], motors[NUMBERS][0, at.FOOT_AHEAD]
    total = motors[NUMBERS][0, at.MOTOR_INERTIA]
    x, first, second, third, height = foot, 0.0, 0.0, 0.0, 0.0
    height_2 = axes[0, at.LENGTH] * turns[1]
    height_3 = height_2 + axes[1, at.LENGTH] * turns[3]
    for k in range(at.AXES):
        c, s = turns[2 * k], turns[2 * k + 1]
        mass, own = axes[k, at.MASS], axes[k, at.INERTIA]
        far = x + axes[k, at.COM_X] * c - axes[k, at.COM_Y] * s
        high = height + axes[k, at.COM_X] * s + axes[k, at.COM_Y] * c
        total += mass * far * far + own * c * c
        # A joint turns all following bodies about its axis, so dX/dpsi is minus the height above the joint.
        turn = -2.0 * own * c * s
        first += turn - 2.0 * mass * far * high
        if k > 0:
            second += turn - 2.0 * mass * far * (high - height_2)
        if k > 1:
            third += turn - 2.0 * mass * far * (high - height_3)
        x += axes[k, at.LENGTH] * c
        height += axes[k, at.LENGTH] * s
    frozen[INERTIA], frozen[BY_JOINT], frozen[BY_JOINT + 1], frozen[BY_JOINT + 2] = total, first, second, third


@inlined
def highest_load(m: int, state: Array, motors: Motors) -> float:
    """Return the largest pressure (Pa) of the ports connected to pump `m`; a very low value without any."""
    most, opened = -1e9, motors[OPENED]
    for i in range(at.MOTORS):
        if motors[NUMBERS][i, at.MOTOR_PUMP] == m:
            if opened[i, IN_A] > 0.0:
                most = max(most, state[i, at.PORT_A])
            if opened[i, IN_B] > 0.0:
                most = max(most, state[i, at.PORT_B])
    return most


@inlined
def drag(i: int, speed: float, motors: Motors) -> tuple[float, float]:
    """Return the friction (N m, N) of motor `i` at a speed, and its slope."""
    numbers = motors[NUMBERS]
    dry = numbers[i, at.MOTOR_COULOMB]
    if motors[STATE][i, at.IDLE] >= numbers[i, at.BRAKE_DELAY]:
        dry += numbers[i, at.BRAKE]
    q = 1.0 / (speed * speed + STILL * STILL)
    root = math.sqrt(q)
    viscous = numbers[i, at.MOTOR_VISCOUS]
    return dry * speed * root + viscous * speed, dry * STILL * STILL * q * root + viscous


@inlined
def port_flows(pressure: float, i: int, motors: Motors, plant: Array) -> tuple[float, float]:
    """Return inflow (m^3/s) of a port of motor `i` through relief, make-up check and drain, and its slope (<= 0)."""
    numbers = motors[NUMBERS]
    flow, slope = hydraulics.port_flows(pressure, NEVER, numbers[i, at.MOTOR_DRAIN] * plant[at.THINNING], plant)
    above, relief_slope = pressure - numbers[i, at.MOTOR_RELIEF], numbers[i, at.MOTOR_SLOPE]
    # The slope is smaller than for cylinders: ports have a small oil volume, and a step would chatter about a steep
    # one.
    if above > 0.0:
        return flow - relief_slope * above, slope - relief_slope
    return flow, slope


@inlined
def port_rates(
    i: int, state: Array, supply: tuple[float, float], motors: Motors, plant: Array, jacobian: bool
) -> tuple[float, float, float]:
    """Return the rates of both ports of motor `i` and the flow from its pump, m^3/s; optionally with derivatives.

    `supply` contains the pump pressure, and the load pressure that a compensated section signals instead of a lower
    load.
    """
    numbers, opened, e = motors[NUMBERS], motors[OPENED], motors[SLOPE]
    a, b, tank = state[i, at.PORT_A], state[i, at.PORT_B], plant[at.TANK]
    check, most = plant[at.REGEN_CHECK], plant[at.SECTION_DROP]
    q_a, a_a = port_flows(a, i, motors, plant)
    q_b, b_b = port_flows(b, i, motors, plant)
    in_a, a_p, a_load = hydraulics.section(opened[i, IN_A], supply[0], a, supply[1], check, most)
    in_b, b_p, b_load = hydraulics.section(opened[i, IN_B], supply[0], b, supply[1], check, most)
    out_a, a_out = hydraulics.drain(opened[i, OUT_A], a - tank, 1.0)
    out_b, b_out = hydraulics.drain(opened[i, OUT_B], b - tank, 1.0)
    across = numbers[i, at.MOTOR_LEAK] * plant[at.THINNING]
    through = across * (a - b) + numbers[i, at.SWEPT] * state[i, at.SPEED]
    c_a = hydraulics.stiffness(a, plant) / numbers[i, at.MOTOR_VOLUME]
    c_b = hydraulics.stiffness(b, plant) / numbers[i, at.MOTOR_VOLUME]
    if jacobian:
        e[i, C_A], e[i, C_B], e[i, A_BY_P], e[i, B_BY_P], e[i, ACROSS] = c_a, c_b, a_p, b_p, across
        e[i, A_BY_A], e[i, B_BY_B] = a_a - a_load - a_out - across, b_b - b_load - b_out - across
    return c_a * (q_a + in_a - out_a - through), c_b * (q_b + in_b - out_b + through), in_a + in_b


@pasted
def present(motors: Motors, first: bool) -> Array:
    """State at the first stage of a step, or at the second."""
    return motors[STATE] if first else motors[STAGE]


@inlined
def rates(
    joints: tuple[float, float, float],
    supply: tuple[float, float, float, float],
    motors: Motors,
    plant: Array,
    jacobian: bool,
    front: Array,
) -> tuple[float, float]:
    """Compute rates into `motors[RATES]` (torques not yet divided by the inertia).

    Return the flow from both pumps, m^3/s.

    Args:
        joints: joint rates of the front, rad/s.
        supply: pressures of both pumps, and the load pressures that compensated sections signal to the pumps, Pa.
        motors: state of the motors: the current one if derivatives are requested, otherwise that of the second stage.
        plant: parameters.
        jacobian: whether derivatives are requested.
        front: torque balance of the front, to which the centrifugal torques of the swing are added.
    """
    state = present(motors, jacobian)
    numbers, frozen, out, e = motors[NUMBERS], motors[FROZEN], motors[RATES], motors[SLOPE]
    first = second = 0.0
    for i in range(at.MOTORS):
        from_second = numbers[i, at.MOTOR_PUMP] > 0.0
        fed = (supply[1], supply[3]) if from_second else (supply[0], supply[2])
        out[i, at.PORT_A], out[i, at.PORT_B], drawn = port_rates(i, state, fed, motors, plant, jacobian)
        if from_second:
            second += drawn
        else:
            first += drawn
        speed = state[i, at.SPEED]
        lost, slope = drag(i, speed, motors)
        out[i, at.SPEED] = numbers[i, at.SWEPT] * (state[i, at.PORT_A] - state[i, at.PORT_B]) - lost
        if jacobian:
            e[i, DRAG], e[i, MOVED] = slope, frozen[INERTIA] if i == 0 else numbers[i, at.MOTOR_INERTIA]
    turn = frozen[BY_JOINT] * joints[0] + frozen[BY_JOINT + 1] * joints[1] + frozen[BY_JOINT + 2] * joints[2]
    out[0, at.SPEED] -= state[0, at.SPEED] * turn
    fling = 0.5 * state[0, at.SPEED] * state[0, at.SPEED]
    for i in range(at.AXES):
        front[at.RATE + i] += fling * frozen[BY_JOINT + i]
    return first, second


@inlined
def eliminate(g: float, pumps: tuple[float, float], motors: Motors) -> tuple[float, float]:
    """Eliminate the motors as linear functions of pump pressure; return their terms on the pump diagonals.

    `pumps` are g times stiffness over volume of both pump lines.
    """
    numbers, e = motors[NUMBERS], motors[SLOPE]
    first = second = 0.0
    for i in range(at.MOTORS):
        ca, cb, swept = g * e[i, C_A], g * e[i, C_B], numbers[i, at.SWEPT]
        aa, ab = 1.0 - ca * e[i, A_BY_A], -ca * e[i, ACROSS]
        ba, bb = -cb * e[i, ACROSS], 1.0 - cb * e[i, B_BY_B]
        det = 1.0 / (aa * bb - ab * ba)
        t_aa, t_ab, t_ba, t_bb = bb * det, -ab * det, -ba * det, aa * det
        e[i, T_AA], e[i, T_AB], e[i, T_BA], e[i, T_BB] = t_aa, t_ab, t_ba, t_bb
        a_w, b_w = swept * (t_ab * cb - t_aa * ca), swept * (t_bb * cb - t_ba * ca)
        fed_a, fed_b = ca * e[i, A_BY_P], cb * e[i, B_BY_P]
        a_p, b_p = t_aa * fed_a + t_ab * fed_b, t_ba * fed_a + t_bb * fed_b
        left = 1.0 / (e[i, MOVED] + g * e[i, DRAG] - g * swept * (a_w - b_w))
        w_p = left * g * swept * (a_p - b_p)
        a_p += a_w * w_p
        b_p += b_w * w_p
        e[i, A_BY_W], e[i, B_BY_W], e[i, W_LEFT], e[i, W_P], e[i, A_P], e[i, B_P] = a_w, b_w, left, w_p, a_p, b_p
        own = e[i, A_BY_P] * (1.0 - a_p) + e[i, B_BY_P] * (1.0 - b_p)
        if numbers[i, at.MOTOR_PUMP] > 0.0:
            second += pumps[1] * own
        else:
            first += pumps[0] * own
    return first, second


@inlined
def known(g: float, pumps: tuple[float, float], motors: Motors) -> tuple[float, float]:
    """Compute the motor terms from `motors[RHS]`; return their terms on the pump right-hand sides."""
    numbers, r, e = motors[NUMBERS], motors[RHS], motors[SLOPE]
    first = second = 0.0
    for i in range(at.MOTORS):
        a = e[i, T_AA] * r[i, at.PORT_A] + e[i, T_AB] * r[i, at.PORT_B]
        b = e[i, T_BA] * r[i, at.PORT_A] + e[i, T_BB] * r[i, at.PORT_B]
        w = e[i, W_LEFT] * (r[i, at.SPEED] + g * numbers[i, at.SWEPT] * (a - b))
        a += e[i, A_BY_W] * w
        b += e[i, B_BY_W] * w
        e[i, W_K], e[i, A_K], e[i, B_K] = w, a, b
        own = e[i, A_BY_P] * a + e[i, B_BY_P] * b
        if numbers[i, at.MOTOR_PUMP] > 0.0:
            second += pumps[1] * own
        else:
            first += pumps[0] * own
    return first, second


@inlined
def fill(first: float, second: float, motors: Motors) -> None:
    """Compute the changes of the motors, into `motors[K2]`, from the changes of both pump pressures."""
    e, out = motors[SLOPE], motors[K2]
    for i in range(at.MOTORS):
        p = second if motors[NUMBERS][i, at.MOTOR_PUMP] > 0.0 else first
        out[i, at.SPEED] = e[i, W_K] + e[i, W_P] * p
        out[i, at.PORT_A] = e[i, A_K] + e[i, A_P] * p
        out[i, at.PORT_B] = e[i, B_K] + e[i, B_P] * p


@inlined
def first_stage(motors: Motors) -> None:
    """Compute the right-hand sides of the first stage of ROS2."""
    for i in range(at.MOTORS):
        for n in range(at.WAY):
            motors[RHS][i, n] = motors[RATES][i, n]


@inlined
def to_stage(motors: Motors, h: float) -> None:
    """Keep the first stage's changes, and the state at its end."""
    for i in range(at.MOTORS):
        for n in range(at.WAY):
            motors[K1][i, n] = motors[K2][i, n]
            motors[STAGE][i, n] = motors[STATE][i, n] + h * motors[K1][i, n]


@inlined
def second_stage(motors: Motors) -> None:
    """Compute the right-hand sides of the second stage; rows of the speeds contain the inertia instead of 1."""
    f, k1, out = motors[RATES], motors[K1], motors[RHS]
    for i in range(at.MOTORS):
        out[i, at.SPEED] = f[i, at.SPEED] - 2.0 * motors[SLOPE][i, MOVED] * k1[i, at.SPEED]
        out[i, at.PORT_A] = f[i, at.PORT_A] - 2.0 * k1[i, at.PORT_A]
        out[i, at.PORT_B] = f[i, at.PORT_B] - 2.0 * k1[i, at.PORT_B]


@inlined
def finish(motors: Motors, h: float) -> None:
    """Complete the ROS2 step."""
    for i in range(at.MOTORS):
        for n in range(at.WAY):
            motors[STATE][i, n] += h * (1.5 * motors[K1][i, n] + 0.5 * motors[K2][i, n])


@inlined
def settle(motors: Motors, step_s: float) -> int:
    """Finish a step: update the time since the spools closed, raise pressures to the floor, and return their count."""
    state, lifted = motors[STATE], 0
    for i in range(at.MOTORS):
        closed = abs(motors[VALVES][i, at.SPOOL]) <= motors[NUMBERS][i, at.MOTOR_DEAD_BAND]
        state[i, at.IDLE] = state[i, at.IDLE] + step_s if closed else 0.0
        for n in range(at.PORT_A, at.WAY):
            if state[i, n] < at.LOWEST_PRESSURE:
                state[i, n] = at.LOWEST_PRESSURE
                lifted += 1
    return lifted


@inlined
def hold_commands(motors: Motors, sample: float) -> None:
    """Set the commands active at `sample`, a fractional row of the demands."""
    for i in range(at.MOTORS):
        motors[HELD][i] = motors[DEMANDS][max(int(np.floor(sample - motors[DELAYS][i])), 0), i]


@inlined
def write_log(motors: Motors, row: int, demand: int) -> None:
    """Write one logged sample to `row` of the log; `demand` is the matching row of the demands."""
    log, state = motors[LOG], motors[STATE]
    for i in range(at.MOTORS):
        log[row, at.LOG_MOTOR_SPEED + i] = state[i, at.SPEED]
        log[row, at.LOG_MOTOR_A + i], log[row, at.LOG_MOTOR_B + i] = state[i, at.PORT_A], state[i, at.PORT_B]
        log[row, at.LOG_MOTOR_DEMAND + i] = motors[DEMANDS][demand, i]
        log[row, at.LOG_MOTOR_SPOOL + i] = motors[VALVES][i, at.SPOOL]
    log[row, at.LOG_SWING] = state[0, at.WAY]


@inlined
def relieved(motors: Motors) -> bool:
    """Return whether the relief of a port is open."""
    state, opened = motors[STATE], False
    for i in range(at.MOTORS):
        relief = motors[NUMBERS][i, at.MOTOR_RELIEF]
        opened = opened or state[i, at.PORT_A] > relief or state[i, at.PORT_B] > relief
    return opened


@inlined
def power(motors: Motors) -> float:
    """Return the power (W) that the motors take from the oil."""
    watts, state = 0.0, motors[STATE]
    for i in range(at.MOTORS):
        watts += motors[NUMBERS][i, at.SWEPT] * (state[i, at.PORT_A] - state[i, at.PORT_B]) * state[i, at.SPEED]
    return watts


@compiled
def shape_demand(lever: Array, zone: float, out: Array) -> None:
    """Convert lever positions in [-1, 1] to signed demands of the spools, both of shape (3,)."""
    for i in range(at.MOTORS):
        out[i] = math.copysign(min(max((abs(lever[i]) - zone) / (1.0 - zone), 0.0), 1.0), lever[i])
