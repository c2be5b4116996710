"""The load of a grey box whose linkage is known: planar rigid bodies, each turned by one cylinder against the last.

Angles theta_a = psi_1 + ... + psi_a, where psi_a is a function of one stroke: quintic polynomials between knots, which
have angle, slope and curvature of the linkage there. With R = d theta / d s, the equations of Lagrange are::

    R' (A R v' + A gamma + c + g) = forces,   gamma_a = sum_{k <= a} psi_k'' v_k^2

A_aa = H_a and A_ab = L_a (X_b cos D - Y_b sin D), D = theta_b - theta_a for a < b; c are centrifugal torques by the
squares of d theta / dt, g_a = G (X_a cos theta_a - Y_a sin theta_a). All is linear in the moments X, Y and the inertias
H of `base_of`, so energy is neither made nor lost, whatever the bodies.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import compiled, inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BEYOND = 1.0
"""Share of a stretch between knots by which the polynomials are followed beyond the first and last knot: the angle
goes on in a straight line there, so that a run which leaves the stroke stays finite."""


@inner
def joint_angle(linkage: Array, joint: int, stroke: float) -> tuple[float, float, float, float]:
    """Joint angle (rad) at a stroke (m), and its three derivatives by it; `joint` is where the joint's values begin."""
    low, high = 0, at.LINKAGE_KNOTS - 1
    while high - low > 1:
        middle = (low + high) // 2
        if linkage[joint + at.KNOT + at.KNOT_VALUES * middle] > stroke:
            high = middle
        else:
            low = middle
    k = joint + at.KNOT + at.KNOT_VALUES * low
    after = k + at.KNOT_VALUES
    width = linkage[after] - linkage[k]
    along = (stroke - linkage[k]) / width
    inside = min(max(along, -BEYOND), 1.0 + BEYOND)
    rise = linkage[after + 1] - linkage[k + 1]
    d_0, d_1 = linkage[k + 2] * width, linkage[after + 2] * width
    b_0, b_1 = linkage[k + 3] * width * width, linkage[after + 3] * width * width
    c_3 = 10.0 * rise - 6.0 * d_0 - 4.0 * d_1 - 1.5 * b_0 + 0.5 * b_1
    c_4 = -15.0 * rise + 8.0 * d_0 + 7.0 * d_1 + 1.5 * b_0 - b_1
    c_5 = 6.0 * rise - 3.0 * (d_0 + d_1) - 0.5 * (b_0 - b_1)
    u = inside
    value = linkage[k + 1] + u * (d_0 + u * (0.5 * b_0 + u * (c_3 + u * (c_4 + u * c_5))))
    first = (d_0 + u * (b_0 + u * (3.0 * c_3 + u * (4.0 * c_4 + u * 5.0 * c_5)))) / width
    outside = along - inside
    if outside != 0.0:
        return value + outside * width * first, first, 0.0, 0.0
    second = (b_0 + u * (6.0 * c_3 + u * (12.0 * c_4 + u * 20.0 * c_5))) / (width * width)
    third = (6.0 * c_3 + u * (24.0 * c_4 + u * 60.0 * c_5)) / (width * width * width)
    return value, first, second, third


@compiled
def base_of(q: Array, load: int, linkage: Array, base: Array, by_number: Array) -> None:
    """Moments X_a, Y_a and inertias H_a of all bodies about their joints, and their slopes by masses and centres.

    X_a = m_a x_a + L_a m, Y_a = m_a y_a, H_a = I_a + m_a (x_a^2 + y_a^2) + L_a^2 m; m is the mass of all bodies behind.

    Args:
        q: numbers.
        load: place of the first body's.
        linkage: of `layout`.
        base: written: X, Y, H of the first body, of the second ... ``(BASE,)``.
        by_number: written ``(BASE, number of a body's)``.
    """
    by_number[:] = 0.0
    for a in range(at.BODIES):
        own = at.BODY_VALUES * a
        k = load + own
        mass, x, y = q[k + at.MASS], q[k + at.CENTRE_X], q[k + at.CENTRE_Y]
        row = 3 * a
        base[row], base[row + 1], base[row + 2] = mass * x, mass * y, q[k + at.INERTIA] + mass * (x * x + y * y)
        by_number[row, own + at.MASS], by_number[row, own + at.CENTRE_X] = x, mass
        by_number[row + 1, own + at.MASS], by_number[row + 1, own + at.CENTRE_Y] = y, mass
        by_number[row + 2, own + at.MASS], by_number[row + 2, own + at.INERTIA] = x * x + y * y, 1.0
        by_number[row + 2, own + at.CENTRE_X] = 2.0 * mass * x
        by_number[row + 2, own + at.CENTRE_Y] = 2.0 * mass * y
        for b in range(a + 1, at.BODIES):
            length, behind = linkage[at.LENGTH + a], q[load + at.BODY_VALUES * b + at.MASS]
            base[row] += length * behind
            base[row + 2] += length * length * behind
            by_number[row, at.BODY_VALUES * b + at.MASS] = length
            by_number[row + 2, at.BODY_VALUES * b + at.MASS] = length * length


@inner
def fill_pose(
    linkage: Array, strokes: Array, v: Array, which: IntArray, turn: Array, absolute: Array, parts: Array, torque: Array
) -> None:
    """Compute positions and rotation of the bodies, and inertia and torques from the parameters of `base_of`.

    Args:
        linkage: of `layout`.
        strokes: ``(actuator,)``; `v` their velocities.
        v: velocities.
        which: written: the actuator of each body.
        turn: written: first to third derivative of each joint's angle, then its actuator's velocity ``(4, body)``.
        absolute: written: cosine, sine, rate and gamma of each body ``(4, body)``.
        parts: written: inertia by each number, rows and columns as the actuators ``(BASE, actuator, actuator)``.
        torque: written: torque on each body by each number ``(BASE, body)``.
    """
    angle, rate, bend = 0.0, 0.0, 0.0
    for a in range(at.BODIES):
        joint = at.JOINTS + a * at.JOINT_VALUES
        which[a] = int(linkage[joint + at.ACTUATOR])
        speed = v[which[a]]
        psi, turn[0, a], turn[1, a], turn[2, a] = joint_angle(linkage, joint, strokes[which[a]])
        turn[3, a] = speed
        angle += psi
        rate += turn[0, a] * speed
        bend += turn[1, a] * speed * speed
        absolute[0, a], absolute[1, a] = math.cos(angle), math.sin(angle)
        absolute[2, a], absolute[3, a] = rate, bend
    parts[:], torque[:] = 0.0, 0.0
    for b in range(at.BODIES):
        row = 3 * b
        torque[row, b] = linkage[at.GRAVITY] * absolute[0, b]
        torque[row + 1, b] = -linkage[at.GRAVITY] * absolute[1, b]
        torque[row + 2, b] = absolute[3, b]
        for i in range(b + 1):
            for j in range(b + 1):
                parts[row + 2, which[i], which[j]] = turn[0, i] * turn[0, j]
        for a in range(b):
            _couple(linkage[at.LENGTH + a], a, b, which, turn, absolute, parts, torque)


@inner
def _couple(
    length: float, a: int, b: int, which: IntArray, turn: Array, absolute: Array, parts: Array, torque: Array
) -> None:
    """Add the coupling between body `b` and a body `a` that carries it, by both moments of b."""
    cosine = length * (absolute[0, a] * absolute[0, b] + absolute[1, a] * absolute[1, b])
    sine = length * (absolute[0, a] * absolute[1, b] - absolute[1, a] * absolute[0, b])
    rate_a, rate_b = absolute[2, a] * absolute[2, a], absolute[2, b] * absolute[2, b]
    x, y = 3 * b, 3 * b + 1
    torque[x, a] += cosine * absolute[3, b] - sine * rate_b
    torque[x, b] += cosine * absolute[3, a] + sine * rate_a
    torque[y, a] -= sine * absolute[3, b] + cosine * rate_b
    torque[y, b] += cosine * rate_a - sine * absolute[3, a]
    for i in range(b + 1):
        for j in range(b + 1):
            # Both bodies turn with the joints up to a, b alone with those between them.
            times = (1.0 if i <= a else 0.0) + (1.0 if j <= a else 0.0)
            share = times * turn[0, i] * turn[0, j]
            parts[x, which[i], which[j]] += share * cosine
            parts[y, which[i], which[j]] -= share * sine


@inner
def freeze_linkage(
    q: Array,
    load: int,
    strokes: Array,
    v: Array,
    linkage: Array,
    loads: tuple[Array, ...],
    full: bool,
) -> None:
    """Inertia and forces of gravity and of turning at the frozen strokes, with their slopes.

    Args:
        q: numbers.
        load: place of the first body's.
        strokes: ``(actuator,)``.
        v: velocities ``(actuator,)``.
        linkage: of `layout`.
        loads: written: forces; their slopes by strokes, velocities and numbers; inertia, its gradient by the strokes;
            inertia by the numbers of `base_of`, and these by masses and centres.
        full: whether the slopes are wanted.
    """
    force, force_s, force_v, force_q, mass, by_mass, parts, by_number = loads
    which, turn, absolute = np.empty(at.BODIES, np.int64), np.empty((4, at.BODIES)), np.empty((4, at.BODIES))
    torque, base = np.empty((at.BASE, at.BODIES)), np.empty(at.BASE)
    base_of(q, load, linkage, base, by_number)
    fill_pose(linkage, strokes, v, which, turn, absolute, parts, torque)
    force[:], mass[:] = 0.0, 0.0
    for row in range(at.BASE):
        mass += base[row] * parts[row]
        behind = 0.0
        for i in range(at.BODIES - 1, -1, -1):
            behind += torque[row, i]
            force[which[i]] += base[row] * turn[0, i] * behind
            # Kept: the stroke's force by each number.
            torque[row, i] = turn[0, i] * behind
    if full:
        for i in range(at.BODIES):
            for m in range(at.BODIES * at.BODY_VALUES):
                slope = 0.0
                for row in range(at.BASE):
                    slope += torque[row, i] * by_number[row, m]
                force_q[which[i], load + m] = slope
        _by_state(base, linkage, which, turn, absolute, force, (force_s, force_v), by_mass)


@inner
def _by_state(
    base: Array,
    linkage: Array,
    which: IntArray,
    turn: Array,
    absolute: Array,
    force: Array,
    slopes: tuple[Array, Array],
    by_mass: Array,
) -> None:
    """Slopes of the forces by strokes and velocities, and of the inertia by strokes."""
    coupled, turned = np.zeros((at.BODIES, at.BODIES)), np.zeros((at.BODIES, at.BODIES))
    for b in range(at.BODIES):
        coupled[b, b] = base[3 * b + 2]
        for a in range(b):
            length = linkage[at.LENGTH + a]
            cosine = length * (absolute[0, a] * absolute[0, b] + absolute[1, a] * absolute[1, b])
            sine = length * (absolute[0, a] * absolute[1, b] - absolute[1, a] * absolute[0, b])
            coupled[a, b] = coupled[b, a] = base[3 * b] * cosine - base[3 * b + 1] * sine
            # Of a pair: minus the slope of their coupling by the angle between them.
            turned[a, b] = base[3 * b] * sine + base[3 * b + 1] * cosine
    for k in range(at.BODIES):
        by_stroke, by_speed = slopes[0][:, which[k]], slopes[1][:, which[k]]
        speed = turn[3, k]
        pull = turn[1, k] * speed, turn[2, k] * speed * speed
        _along(k, pull, turn[0, k], (base, linkage), (which, turn, absolute, coupled, turned), by_stroke)
        by_stroke[which[k]] += turn[1, k] / turn[0, k] * force[which[k]]
        pull = turn[0, k], 2.0 * turn[1, k] * speed
        _along(k, pull, 0.0, (base, linkage), (which, turn, absolute, coupled, turned), by_speed)
        _mass_along(k, which, turn, coupled, turned, by_mass)


@inner
def _along(
    k: int,
    pull: tuple[float, float],
    swing: float,
    numbers: tuple[Array, Array],
    of: tuple[IntArray, Array, Array, Array, Array],
    out: Array,
) -> None:
    """Change of the strokes' forces with joint `k`, into `out` ``(actuator,)``.

    Args:
        k: the joint; all bodies from it on change.
        pull: what their rates and gammas change by.
        swing: what their angles change by.
        numbers: of `base_of`, and the linkage.
        of: actuators, derivatives, pose, couplings and their slopes.
        out: written.
    """
    (base, linkage), (which, turn, absolute, coupled, turned) = numbers, of
    torque = np.zeros(at.BODIES)
    for a in range(at.BODIES):
        if a >= k:
            weight = base[3 * a] * absolute[1, a] + base[3 * a + 1] * absolute[0, a]
            torque[a] += coupled[a, a] * pull[1] - linkage[at.GRAVITY] * weight * swing
        for b in range(a + 1, at.BODIES):
            if b < k:
                continue
            # The angle between both changes where the joint lies between them.
            apart = swing if a < k else 0.0
            both, slope = coupled[a, b], turned[a, b]
            rate_a, rate_b = absolute[2, a], absolute[2, b]
            torque[a] += both * pull[1] - apart * slope * absolute[3, b]
            torque[a] -= apart * both * rate_b * rate_b + 2.0 * slope * rate_b * pull[0]
            torque[b] += apart * (both * rate_a * rate_a - slope * absolute[3, a])
            if a >= k:
                torque[b] += both * pull[1] + 2.0 * slope * rate_a * pull[0]
    behind = 0.0
    out[:] = 0.0
    for i in range(at.BODIES - 1, -1, -1):
        behind += torque[i]
        out[which[i]] = turn[0, i] * behind


@inner
def _mass_along(k: int, which: IntArray, turn: Array, coupled: Array, turned: Array, by_mass: Array) -> None:
    """Slopes of the inertia by the stroke of joint `k`."""
    for i in range(at.BODIES):
        for j in range(at.BODIES):
            whole, swung = 0.0, 0.0
            for a in range(i, at.BODIES):
                for b in range(j, at.BODIES):
                    whole += coupled[a, b]
                    near, far = min(a, b), max(a, b)
                    swung -= turned[near, far] * turn[0, k] if near < k <= far else 0.0
            slope = turn[0, i] * turn[0, j] * swung
            slope += turn[1, i] * turn[0, j] * whole if i == k else 0.0
            slope += turn[0, i] * turn[1, j] * whole if j == k else 0.0
            by_mass[which[i], which[j], which[k]] = slope


@inner
def inertia_by_numbers(i: int, change: Array, parts: Array, by_number: Array, load: int, row: int, by_q: Array) -> None:
    """Add the slopes of row `i` of M times a change of the velocities by masses and centres to row `row` of `by_q`."""
    for base in range(at.BASE):
        along = 0.0
        for k in range(len(change)):
            along += parts[base, i, k] * change[k]
        for m in range(at.BODIES * at.BODY_VALUES):
            by_q[row, load + m] += along * by_number[base, m]


@compiled
def balance_by_base(strokes: Array, speeds: Array, pulls: Array, linkage: Array, out: Array) -> None:
    """Compute forces on the strokes by the parameters of `base_of`, for strokes, velocities and accelerations.

    Args:
        strokes: ``(row, actuator)``; `speeds` and `pulls` likewise.
        speeds: velocities.
        pulls: accelerations.
        linkage: of `layout`.
        out: written ``(row, actuator, BASE)``.
    """
    n = strokes.shape[1]
    which, turn, absolute = np.empty(at.BODIES, np.int64), np.empty((4, at.BODIES)), np.empty((4, at.BODIES))
    torque, parts = np.empty((at.BASE, at.BODIES)), np.empty((at.BASE, n, n))
    for t in range(len(strokes)):
        fill_pose(linkage, strokes[t], speeds[t], which, turn, absolute, parts, torque)
        for base in range(at.BASE):
            for i in range(n):
                out[t, i, base] = 0.0
                for k in range(n):
                    out[t, i, base] += parts[base, i, k] * pulls[t, k]
            behind = 0.0
            for i in range(at.BODIES - 1, -1, -1):
                behind += torque[base, i]
                out[t, which[i], base] += turn[0, i] * behind


@compiled
def load_at(q: Array, load: int, strokes: Array, v: Array, linkage: Array, loads: tuple[Array, ...]) -> None:
    """`freeze_linkage` with all slopes, for callers in Python."""
    freeze_linkage(q, load, strokes, v, linkage, loads, True)
