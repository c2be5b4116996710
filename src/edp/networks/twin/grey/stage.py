"""One implicit stage of a grey box: its residual, the derivatives of that, and the Newton iteration on it.

Unknowns y: pressures of all nodes but tank and supply, then velocities. With the base b of the stage, step d and the
strokes frozen, of an L-stable SDIRK method of order two (Alexander 1977, gamma = 1 - 1/sqrt(2))::

    c(p) - b_c - d B / V (net flow - A v) = 0,   M (v - b_v) - d (pressure forces - friction - load - stop) = 0
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import inlined, inner
from edp.networks.twin.grey.linkage import inertia_by_numbers
from edp.networks.twin.grey.motion import friction
from edp.networks.twin.grey.network import port_flows, pump_flows, valve_flows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
ITERATIONS = 30
TOLERANCE = 1e-9
"""Of a Newton step, in MPa and m/s: what is left is far below the rounding of single precision."""
LARGEST = 4.0
"""MPa by which an iteration may move a pressure: the slope of a square root says little about what is far away."""


@inlined
def content(p: float, bulk: float, share: float) -> tuple[float, float, float, float]:
    """How much oil a volume holds, as the pressure (MPa) that would press it in without free air: p - B a p_0 / p_abs.

    Its slope by p is B over the effective bulk modulus of oil with free air, isothermal. Flows add up in it, and it
    rises with p everywhere, so that Newton's method finds the pressure of a chamber that is near to boiling, too.
    Slopes by p, modulus and share of air follow.
    """
    inverse = 1.0 / max(p + at.ATMOSPHERE, at.LEAST_ABSOLUTE)
    air = share * at.ATMOSPHERE * inverse
    return p - bulk * air, 1.0 + bulk * air * inverse, -air, -bulk * at.ATMOSPHERE * inverse


@inner
def _node_row(
    node: int,
    volume: float,
    area: float,
    now: tuple[Array, Array, float],
    q: Array,
    circuit: int,
    sums: tuple[Array, ...],
    out: tuple[Array, ...],
    full: bool,
) -> tuple[float, float]:
    """Compute residual and derivatives of one pressure; return the volume and area derivatives for chambers."""
    y, base, step = now
    net, jac, net_x, net_s, net_q = sums
    residual, by_y, by_x, by_s, _, by_q = out
    unknown = len(y)
    nodes = len(net) - 2
    speed = nodes + node % (unknown - nodes)
    into = net[node] - area * y[speed]
    bulk = q[circuit + at.BULK]
    oil, by_p, by_bulk, by_air = content(y[node], bulk, q[circuit + at.AIR])
    rate = step * bulk / volume
    residual[node] = oil - base[node] - rate * into
    for other in range(nodes):
        by_y[node, other] = -rate * jac[node, other]
    for other in range(nodes, unknown):
        by_y[node, other] = 0.0
    by_y[node, node] += by_p
    if area != 0.0:
        by_y[node, speed] = rate * area
    if full:
        for j in range(net_x.shape[1]):
            by_x[node, j] = -rate * net_x[node, j]
        for i in range(net_s.shape[1]):
            by_s[node, i] = -rate * net_s[node, i]
        for k in range(len(q)):
            by_q[node, k] = -rate * net_q[node, k]
        by_q[node, circuit + at.BULK] += by_bulk - step / volume * into
        by_q[node, circuit + at.AIR] += by_air
        by_q[node, circuit + at.TANK] -= rate * jac[node, nodes]
        by_q[node, circuit + at.SUPPLY] -= rate * jac[node, nodes + 1]
    return rate * into / volume, rate * y[speed]


@inner
def pressure_rows(
    now: tuple[Array, Array, float],
    strokes: Array,
    q: Array,
    form: tuple[IntArray, ...],
    circuit: int,
    sums: tuple[Array, ...],
    out: tuple[Array, ...],
    full: bool,
) -> None:
    """Rows of all chambers and pump lines."""
    actuator_at, pump_at = form[3], form[4]
    by_s, by_d, by_q = out[3], out[4], out[5]
    n = len(actuator_at)
    for i in range(n):
        a = actuator_at[i]
        for side in range(2):
            area = q[a + at.HEAD_AREA + side]
            stop = a + (at.STOP_LOW if side == 0 else at.STOP_HIGH)
            way = 1.0 if side == 0 else -1.0
            room = way * (strokes[i] - q[stop])
            # Beyond a stop the oil of the dead volume is left.
            inside = 1.0 if room > 0.0 else 0.0
            volume = q[a + at.HEAD_DEAD + side] + area * room * inside
            owed, moved = _node_row(i + side * n, volume, way * area, now, q, circuit, sums, out, full)
            if full:
                row = i + side * n
                by_s[row, i] += owed * area * way * inside
                by_q[row, stop] -= owed * area * way * inside
                by_q[row, a + at.HEAD_DEAD + side] += owed
                by_q[row, a + at.HEAD_AREA + side] += owed * room * inside + way * moved
    for m in range(len(pump_at)):
        a, row = pump_at[m], 2 * n + m
        owed, _ = _node_row(row, q[a + at.LINE], 0.0, now, q, circuit, sums, out, full)
        if full:
            by_q[row, a + at.LINE] += owed
            by_d[row, m] = -now[2] * q[circuit + at.BULK] / q[a + at.LINE] * q[a + at.FLOW]


@inner
def motion_rows(
    now: tuple[Array, Array, float],
    stroke: tuple[Array, Array, float],
    bristle: Array,
    q: Array,
    form: tuple[IntArray, ...],
    load: tuple[Array, ...],
    places: tuple[int, int, int],
    out: tuple[Array, ...],
    full: bool,
) -> None:
    """Rows of all velocities.

    Args:
        now: y, base, step.
        stroke: strokes and velocities at the start of the tick's step, and half the time from it to this stage.
        bristle: deflections of the base.
        q: numbers.
        form: of the model.
        load: at the frozen strokes: forces, L, inertia and its gradient by the strokes; monomials; inertia of a known
            linkage by the numbers of `linkage.base_of`, and these by masses and centres.
        places: of its numbers.
        out: residual and derivatives.
        full: whether those beside by y are wanted.
    """
    y, base, step = now
    residual, by_y, by_x, by_s, _, by_q = out
    force, mass = load[0], load[2]
    n = len(force)
    nodes = len(y) - n
    change = np.zeros(n)
    for i in range(n):
        change[i] = y[nodes + i] - base[nodes + i]
    for i in range(n):
        a, row = form[3][i], nodes + i
        for k in range(nodes):
            by_y[row, k] = 0.0
        by_y[row, i] = -step * q[a + at.HEAD_AREA]
        by_y[row, n + i] = step * q[a + at.ROD_AREA]
        push = q[a + at.HEAD_AREA] * y[i] - q[a + at.ROD_AREA] * y[n + i] - force[i]
        _, rubbing, by_v, _, _, numbers = friction(y[row], bristle[i], step, a, q)
        reached = stroke[0][i] + stroke[2] * (stroke[1][i] + y[row])
        depth = min(reached - q[a + at.STOP_LOW], 0.0) + max(reached - q[a + at.STOP_HIGH], 0.0)
        stop = q[a + at.STOP_STIFFNESS]
        inertial = 0.0
        for k in range(n):
            inertial += mass[i, k] * change[k]
            by_y[row, nodes + k] = mass[i, k]
        residual[row] = inertial - step * (push - rubbing - stop * depth)
        touched = stop if depth != 0.0 else 0.0
        by_y[row, row] += step * (by_v + touched * stroke[2])
        if full:
            for k in range(len(q)):
                by_q[row, k] = 0.0
            for k in range(by_x.shape[1]):
                by_x[row, k] = 0.0
            by_q[row, a + at.HEAD_AREA] -= step * y[i]
            by_q[row, a + at.ROD_AREA] += step * y[n + i]
            by_q[row, a + at.STOP_STIFFNESS] += step * depth
            by_q[row, a + at.STOP_LOW] -= step * touched if depth < 0.0 else 0.0
            by_q[row, a + at.STOP_HIGH] -= step * touched if depth > 0.0 else 0.0
            for k in range(5):
                by_q[row, a + at.COULOMB + k] += step * numbers[k]
            by_q[row, a + at.BRISTLE_DAMPING] += step * numbers[5]
            by_q[row, a + at.ASYMMETRY] += step * numbers[6]
            _inertia_slopes(i, change, load, places, by_s, by_q, nodes)


@inner
def _inertia_slopes(
    i: int,
    change: Array,
    load: tuple[Array, ...],
    places: tuple[int, int, int],
    by_s: Array,
    by_q: Array,
    nodes: int,
) -> None:
    """Compute derivatives of row `i` of M (v - b) by strokes and parameters."""
    _, low, _, by_mass, value, parts, by_number = load
    n = len(change)
    for k in range(n):
        along = 0.0
        for a in range(n):
            along += by_mass[i, a, k] * change[a]
        by_s[nodes + i, k] = along
    if places[1] == 0:
        inertia_by_numbers(i, change, parts, by_number, places[0], nodes + i, by_q)
        return
    index = places[0]
    for a in range(n):
        for c in range(a + 1):
            turned = 0.0
            for m in range(n):
                turned += low[m, c] * change[m]
            slope = low[i, c] * change[a] + (turned if i == a else 0.0)
            for b in range(places[1]):
                by_q[nodes + i, index + b] += value[b] * slope
            index += places[1]


@inner
def factorise(a: Array) -> None:
    """LU in index, without pivots: pressures come first, and their rows are dominated by the diagonal."""
    size = len(a)
    for k in range(size):
        inverse = 1.0 / a[k, k]
        for i in range(k + 1, size):
            if a[i, k] != 0.0:
                a[i, k] *= inverse
                for j in range(k + 1, size):
                    a[i, j] -= a[i, k] * a[k, j]


@inner
def solve(lu: Array, columns: Array) -> None:
    """Replace the columns ``(unknown, column)`` by the solutions."""
    size, count = columns.shape
    for i in range(size):
        for k in range(i):
            if lu[i, k] != 0.0:
                factor = lu[i, k]
                for c in range(count):
                    columns[i, c] -= factor * columns[k, c]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            if lu[i, k] != 0.0:
                factor = lu[i, k]
                for c in range(count):
                    columns[i, c] -= factor * columns[k, c]
        inverse = 1.0 / lu[i, i]
        for c in range(count):
            columns[i, c] *= inverse


@inner
def assemble(
    now: tuple[Array, Array, float],
    x: Array,
    displacement: Array,
    strokes: Array,
    stroke: tuple[Array, Array, float],
    bristle: Array,
    q: Array,
    form: tuple[IntArray, ...],
    load: tuple[Array, ...],
    places: tuple[int, int, int, int],
    knots: Array,
    sums: tuple[Array, ...],
    out: tuple[Array, ...],
    full: bool,
) -> None:
    """Residual and derivatives of all rows, from the spools `x` ``(valve,)``, displacements and frozen strokes."""
    y = now[0]
    n = len(strokes)
    nodes = len(y) - n
    circuit = places[3]
    p = np.empty(nodes + 2)
    p[:nodes] = y[:nodes]
    p[nodes], p[nodes + 1] = q[circuit + at.TANK], q[circuit + at.SUPPLY]
    sums[0][:], sums[1][:] = 0.0, 0.0
    if full:
        sums[2][:], sums[3][:], sums[4][:], out[4][:] = 0.0, 0.0, 0.0, 0.0
    valve_flows(x, strokes, q, p, form, knots, sums, full)
    port_flows(q, p, form, circuit, sums, full)
    pump_flows(x, displacement, q, p, form, circuit, sums, full)
    pressure_rows(now, strokes, q, form, circuit, sums, out, full)
    motion_rows(now, stroke, bristle, q, form, load, (places[0], places[1], places[2]), out, full)


@inner
def newton(
    now: tuple[Array, Array, float],
    x: Array,
    displacement: Array,
    strokes: Array,
    stroke: tuple[Array, Array, float],
    bristle: Array,
    q: Array,
    form: tuple[IntArray, ...],
    load: tuple[Array, ...],
    places: tuple[int, int, int, int],
    knots: Array,
    sums: tuple[Array, ...],
    out: tuple[Array, ...],
    tolerance: float,
) -> int:
    """Solve the stage in index of y, from a guess, until it moves by less than `tolerance`; returns the iterations."""
    y = now[0]
    nodes = len(y) - len(strokes)
    residual, by_y = out[0], out[1]
    columns = np.empty((len(y), 1))
    share, before, at_before = 1.0, 0.0, -1
    for iteration in range(ITERATIONS):
        assemble(now, x, displacement, strokes, stroke, bristle, q, form, load, places, knots, sums, out, False)
        factorise(by_y)
        columns[:, 0] = residual
        solve(by_y, columns)
        most = 0
        for k in range(1, len(y)):
            if abs(columns[k, 0]) > abs(columns[most, 0]):
                most = k
        largest = columns[most, 0]
        # Where a check or a relief toggles, whole steps would go to and fro for ever.
        to_and_fro = most == at_before and largest * before < 0.0 and abs(largest) > 0.5 * abs(before)
        share = max(0.5 * share, 0.125) if to_and_fro else min(2.0 * share, 1.0)
        before, at_before = largest, most
        for k in range(len(y)):
            change = share * columns[k, 0]
            if k < nodes:
                change = min(max(change, -LARGEST), LARGEST)
                # Towards a vacuum by shares of what is left: the content has a pole there.
                y[k] = max(y[k] - change, 0.25 * (y[k] + at.ATMOSPHERE) - at.ATMOSPHERE)
            else:
                y[k] -= change
        if abs(largest) < tolerance:
            return iteration + 1
    return ITERATIONS
