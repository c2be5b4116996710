"""The load of a grey box, its linkage not known: inertia and gravity as polynomials of the strokes.

    M(s) v' + c(s, v) + grad U(s) = A_A p_A - A_B p_B - F_friction - F_stop

M = L L' with polynomial entries of L, so it is positive definite; c are the Coriolis forces that belong to it, and U is
a potential, so that energy is neither made nor lost by the load.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
NEGLIGIBLE = 6.5
"""Multiple of the Stribeck velocity beyond which its effect, exp(-42), is below rounding."""


@inner
def basis(z: Array, exponents: IntArray, scale: Array, table: Array, terms: tuple[Array, Array, Array]) -> None:
    """Monomials of the scaled strokes, their gradients and second derivatives by the strokes.

    Args:
        z: strokes between -1 and 1 ``(actuator,)``.
        exponents: ``(term, actuator)``.
        scale: of z by stroke, 1/m.
        table: scratch ``(3, actuator, degree + 1)``.
        terms: written: ``(term,)``, ``(term, actuator)``, ``(term, actuator, actuator)``.
    """
    value, first, second = terms
    n = len(z)
    for i in range(n):
        power = 1.0
        for e in range(table.shape[2]):
            table[0, i, e] = power
            power *= z[i]
        for e in range(table.shape[2]):
            table[1, i, e] = e * scale[i] * table[0, i, max(e - 1, 0)]
            table[2, i, e] = e * (e - 1) * scale[i] * scale[i] * table[0, i, max(e - 2, 0)]
    for b in range(len(exponents)):
        whole = 1.0
        for i in range(n):
            whole *= table[0, i, exponents[b, i]]
        value[b] = whole
        for k in range(n):
            once = 1.0
            for i in range(n):
                once *= table[1 if i == k else 0, i, exponents[b, i]]
            first[b, k] = once
            for m in range(k, n):
                twice = 1.0
                for i in range(n):
                    order = (1 if i == k else 0) + (1 if i == m else 0)
                    twice *= table[order, i, exponents[b, i]]
                second[b, k, m] = second[b, m, k] = twice


@inner
def freeze_load(
    q: Array,
    places: tuple[int, int, int],
    v: Array,
    terms: tuple[Array, Array, Array],
    root: tuple[Array, Array, Array, Array],
    force: tuple[Array, Array, Array, Array],
    full: bool,
) -> None:
    """Inertia and its gradient, and the forces of gravity and of turning, at the frozen strokes.

    Args:
        q: numbers.
        places: of the first coefficient of L, how many each entry has, and of the first of U.
        v: velocities ``(actuator,)``.
        terms: of `basis`.
        root: written: L ``(actuator, actuator)``, its gradient ``(actuator, actuator, stroke)``, then inertia M = L L'
            and, if `full`, its gradient likewise.
        force: written: the forces, and their slopes by strokes, velocities and numbers.
        full: whether the slopes are wanted.
    """
    value, first, second = terms
    inertia_at, count, potential_at = places
    total, total_s, total_v, total_q = force
    low, by_s = root[0], root[1]
    n = len(v)
    first_of_entry = inertia_at
    for a in range(n):
        for c in range(n):
            low[a, c] = 0.0
            for k in range(n):
                by_s[a, c, k] = 0.0
            if c > a:
                continue
            for b in range(count):
                low[a, c] += q[first_of_entry + b] * value[b]
                for k in range(n):
                    by_s[a, c, k] += q[first_of_entry + b] * first[b, k]
            first_of_entry += count
    _squared(root, full)
    for i in range(n):
        total[i] = 0.0
        for b in range(1, len(value)):
            total[i] += q[potential_at + b - 1] * first[b, i]
            if full:
                total_q[i, potential_at + b - 1] = first[b, i]
        if full:
            for k in range(n):
                total_v[i, k] = 0.0
                total_s[i, k] = 0.0
                for b in range(1, len(value)):
                    total_s[i, k] += q[potential_at + b - 1] * second[b, i, k]
    _turning(q, places, v, terms, low, by_s, force, full)


@inner
def _squared(root: tuple[Array, Array, Array, Array], full: bool) -> None:
    """M = L L' and its gradient, from L and its own."""
    low, by_s, mass, by_mass = root
    n = len(low)
    for i in range(n):
        for k in range(n):
            mass[i, k] = 0.0
            for c in range(min(i, k) + 1):
                mass[i, k] += low[i, c] * low[k, c]
            for m in range(n if full else 0):
                along = 0.0
                for c in range(min(i, k) + 1):
                    along += by_s[i, c, m] * low[k, c] + low[i, c] * by_s[k, c, m]
                by_mass[i, k, m] = along


@inner
def _turning(
    q: Array,
    places: tuple[int, int, int],
    v: Array,
    terms: tuple[Array, Array, Array],
    low: Array,
    by_s: Array,
    force: tuple[Array, Array, Array, Array],
    full: bool,
) -> None:
    """Add the Coriolis forces: c = L. w + L u - e, with w = L'v, u = L.'v and e_i = w . (dL_i' v)."""
    second = terms[2]
    total, total_s, total_v, total_q = force
    n = len(v)
    dot, w, u, along = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros((n, n))
    for a in range(n):
        for c in range(n):
            w[c] += low[a, c] * v[a]
            for k in range(n):
                dot[a, c] += by_s[a, c, k] * v[k]
                along[k, c] += by_s[a, c, k] * v[a]
    for a in range(n):
        for c in range(n):
            u[c] += dot[a, c] * v[a]
    for i in range(n):
        for c in range(n):
            total[i] += dot[i, c] * w[c] + low[i, c] * u[c] - w[c] * along[i, c]
    if full:
        _turning_by_numbers(places, v, terms, low, (dot, w, u, along), total_q)
        _turning_by_state(q, places, v, second, (low, by_s), (dot, w, u, along), (total_s, total_v))


@inner
def _turning_by_numbers(
    places: tuple[int, int, int],
    v: Array,
    terms: tuple[Array, Array, Array],
    low: Array,
    of: tuple[Array, Array, Array, Array],
    total_q: Array,
) -> None:
    """Slopes of the Coriolis forces by the coefficients of L; `of`: L., w, u and dL' v."""
    value, first, _ = terms
    inertia_at, count, _ = places
    dot, w, u, along = of
    n = len(v)
    first_of_entry = inertia_at
    for a in range(n):
        for c in range(a + 1):
            for b in range(count):
                rate = 0.0
                for k in range(n):
                    rate += v[k] * first[b, k]
                total_q[a, first_of_entry + b] = rate * w[c] + value[b] * u[c]
                for i in range(n):
                    if i != a:
                        total_q[i, first_of_entry + b] = 0.0
                for i in range(n):
                    total_q[i, first_of_entry + b] += (dot[i, c] * value[b] + low[i, c] * rate) * v[a]
                    total_q[i, first_of_entry + b] -= value[b] * v[a] * along[i, c] + w[c] * first[b, i] * v[a]
            first_of_entry += count


@inner
def _turning_by_state(
    q: Array,
    places: tuple[int, int, int],
    v: Array,
    second: Array,
    factor: tuple[Array, Array],
    of: tuple[Array, Array, Array, Array],
    total: tuple[Array, Array],
) -> None:
    """Add the slopes of the Coriolis forces by strokes and velocities; `factor`: L and its gradient."""
    low, by_s = factor
    dot, w, u, along = of
    total_s, total_v = total
    n = len(v)
    dot_k, low_k, own = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n, n))
    for k in range(n):
        # Along stroke k: L changes by its gradient, the gradient by the second derivatives.
        _second(q, places, second, k, own)
        for a in range(n):
            for c in range(n):
                low_k[a, c] = by_s[a, c, k]
                dot_k[a, c] = 0.0
                for m in range(n):
                    dot_k[a, c] += own[a, c, m] * v[m]
        for c in range(n):
            w_k, u_k = 0.0, 0.0
            for a in range(n):
                w_k += low_k[a, c] * v[a]
                u_k += dot_k[a, c] * v[a]
            for i in range(n):
                total_s[i, k] += dot_k[i, c] * w[c] + dot[i, c] * w_k + low_k[i, c] * u[c] + low[i, c] * u_k
                total_s[i, k] -= w_k * along[i, c]
                for a in range(n):
                    total_s[i, k] -= w[c] * own[a, c, i] * v[a]
        # Along velocity k.
        for c in range(n):
            w_k, u_k = low[k, c], dot[k, c]
            for a in range(n):
                u_k += by_s[a, c, k] * v[a]
            for i in range(n):
                total_v[i, k] += by_s[i, c, k] * w[c] + dot[i, c] * w_k + low[i, c] * u_k
                total_v[i, k] -= w_k * along[i, c] + w[c] * by_s[k, c, i]


@inner
def _second(q: Array, places: tuple[int, int, int], second: Array, k: int, own: Array) -> None:
    """Compute derivatives of the gradient of L by stroke `k` ``(actuator, actuator, stroke)``."""
    n = len(own)
    first_of_entry = places[0]
    own[:] = 0.0
    for a in range(n):
        for c in range(a + 1):
            for b in range(places[1]):
                for m in range(n):
                    own[a, c, m] += q[first_of_entry + b] * second[b, k, m]
            first_of_entry += places[1]


@inner
def friction(
    v: float, before: float, step: float, a: int, q: Array
) -> tuple[float, float, float, float, float, tuple[float, float, float, float, float, float, float]]:
    """LuGre friction after an implicit step of its bristle.

    Args:
        v: velocity at the end of the step, m/s.
        before: deflection of the bristle before it, m; `step` its length, s.
        step: s.
        a: place of the actuator's numbers; `q` the numbers.
        q: numbers.

    Returns:
        Deflection (m), force (MN), force by v, force by `before`, deflection by `before`; force by Coulomb, static,
        Stribeck, viscous, bristle stiffness, bristle damping and asymmetry. Deflections by v and these numbers follow
        from `bristle_slopes`.
    """
    stribeck, coulomb, static = q[a + at.STRIBECK], q[a + at.COULOMB], q[a + at.STATIC]
    stiffness, damping, lean = q[a + at.BRISTLE], q[a + at.BRISTLE_DAMPING], q[a + at.ASYMMETRY]
    ratio = v / stribeck
    fade = math.exp(-ratio * ratio) if abs(ratio) < NEGLIGIBLE else 0.0
    level = coulomb + static * fade
    # The implicit step: z = before + step (v - stiffness |v| z / level).
    share = stiffness * step * abs(v) / level
    under = 1.0 / (1.0 + share)
    z = (before + step * v) * under
    force = (stiffness + damping * fade / step) * z - damping * fade / step * before + q[a + at.VISCOUS] * v
    sign = 1.0 if v >= 0.0 else -1.0
    fade_v = -2.0 * ratio / stribeck * fade
    fade_stribeck = 2.0 * ratio * ratio / stribeck * fade
    rate = stiffness + damping * fade / step
    grown = (z - before) / step * damping
    share_level = -share / level
    z_v = step * under - z * under * (stiffness * step * sign / level + share_level * static * fade_v)
    z_level = -z * under * share_level
    # A lean of the force by the sign of v, smooth over the Stribeck velocity.
    tilt = math.tanh(v / stribeck)
    force += lean * tilt * tilt
    slope = rate * z_v + grown * fade_v + q[a + at.VISCOUS] + 2.0 * lean * tilt * (1.0 - tilt * tilt) / stribeck
    by_stribeck = (rate * z_level * static + grown) * fade_stribeck
    by_stribeck -= 2.0 * lean * tilt * (1.0 - tilt * tilt) * ratio / stribeck
    by_bristle = z - rate * z * under * share / stiffness
    numbers = (rate * z_level, rate * z_level * fade, by_stribeck, v, by_bristle, grown * fade / damping, tilt * tilt)
    return z, force, slope, rate * under - damping * fade / step, under, numbers


@inner
def bristle_slopes(
    v: float, before: float, step: float, a: int, q: Array
) -> tuple[float, tuple[float, float, float, float]]:
    """Deflection after the step by v, and by Coulomb, static, Stribeck and bristle stiffness."""
    stribeck, static, stiffness = q[a + at.STRIBECK], q[a + at.STATIC], q[a + at.BRISTLE]
    ratio = v / stribeck
    fade = math.exp(-ratio * ratio) if abs(ratio) < NEGLIGIBLE else 0.0
    level = q[a + at.COULOMB] + static * fade
    share = stiffness * step * abs(v) / level
    under = 1.0 / (1.0 + share)
    z = (before + step * v) * under
    sign = 1.0 if v >= 0.0 else -1.0
    fade_v = -2.0 * ratio / stribeck * fade
    z_v = step * under - z * under * (stiffness * step * sign / level - share / level * static * fade_v)
    z_level = z * under * share / level
    by_stribeck = z_level * static * 2.0 * ratio * ratio / stribeck * fade
    return z_v, (z_level, z_level * fade, by_stribeck, -z * under * share / stiffness)
