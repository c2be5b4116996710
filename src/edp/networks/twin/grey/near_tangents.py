"""Differences between neighbouring runs of a grey box: tangents of its implicit stages, for any spool motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.motion import bristle_slopes, friction
from edp.networks.twin.grey.near_jit import inner
from edp.networks.twin.grey.near_valves import centre
from edp.networks.twin.grey.network import turbulent, valve_flows
from edp.networks.twin.grey.stage import content, solve

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
SAME = 1e-4
"""Share of full by which a spool may differ and count as the same: a per cent of what a plan tries."""


@inner
def _add_spools(
    spools: tuple[Array, NDArray[np.bool_]],
    strokes: Array,
    p: Array,
    rate: Array,
    q: Array,
    form: tuple[IntArray, ...],
    knots: Array,
    sums: tuple[Array, ...],
    right: Array,
) -> None:
    """Add the flows of spools that differ from the first run to the right-hand side, at its pressures.

    Args:
        spools: at this stage, shape (run, valve), and which of them are not those of the first run.
        strokes: m, frozen.
        p: pressures of all nodes, MPa.
        rate: of each node's content by its net flow, over a stage, shape (node,).
        q: numbers.
        form: of the model.
        knots: of the curves.
        sums: scratch.
        right: added to, shape (unknown, column).
    """
    positions, differs = spools
    valve_pump, pump_at = form[2], form[4]
    count, nodes = positions.shape[1], len(rate)
    alone, net = np.zeros(count), np.empty(nodes)
    for j in range(count):
        summed = False
        for run in range(1, len(positions)):
            if not differs[run, j] or abs(positions[run, j] - positions[0, j]) <= SAME:
                continue
            if not summed:
                alone[j], sums[0][:] = positions[0, j], 0.0
                valve_flows(alone, strokes, q, p, form, knots, sums, False)
                net[:], summed = sums[0][:nodes], True
            alone[j], sums[0][:] = positions[run, j], 0.0
            valve_flows(alone, strokes, q, p, form, knots, sums, False)
            for node in range(nodes):
                right[node, run - 1] += rate[node] * (sums[0][node] - net[node])
            m = valve_pump[j]
            if m >= 0:
                node = nodes - len(pump_at) + m
                wider = centre(positions[run], m, q, valve_pump, pump_at[m])
                wider -= centre(positions[0], m, q, valve_pump, pump_at[m])
                right[node, run - 1] -= rate[node] * wider * turbulent(p[node] - p[nodes])[0]
        alone[j] = 0.0


@inner
def _rates(strokes: Array, h: float, q: Array, form: tuple[IntArray, ...], circuit: int, rate: Array) -> None:
    """Content that a net flow brings to each node over a stage of `h` seconds ``(node,)``; `stage.pressure_rows`."""
    actuator_at, pump_at = form[3], form[4]
    n, bulk = len(actuator_at), q[circuit + at.BULK]
    for i in range(n):
        a = actuator_at[i]
        for side in range(2):
            way = 1.0 if side == 0 else -1.0
            room = max(way * (strokes[i] - q[a + at.STOP_LOW + side]), 0.0)
            rate[i + side * n] = h * bulk / (q[a + at.HEAD_DEAD + side] + q[a + at.HEAD_AREA + side] * room)
    for m in range(len(pump_at)):
        rate[2 * n + m] = h * bulk / q[pump_at[m] + at.LINE]


@inner
def stage_of_others(
    d_y: Array,
    bases: tuple[Array, Array, Array, Array],
    spools: tuple[Array, NDArray[np.bool_]],
    flows: Array,
    now: tuple[Array, Array, float, float],
    stroke: tuple[Array, Array, Array],
    q: Array,
    form: tuple[IntArray, ...],
    knots: Array,
    circuit: int,
    sums: tuple[Array, ...],
    load: tuple[Array, Array],
) -> None:
    """Compute the differences of pressures and velocities of all other runs after a stage.

    Args:
        d_y: written, shape (unknown, column), a column a run.
        bases: differences of the stage's base of y, of its bristles, and of strokes and velocities at the step's start.
        spools: of `_add_spools`.
        flows: of the pumps, differences, shape (pump, column).
        now: y after the stage, bristles of its base, its length, and half the time from the step's start to it (s).
        stroke: frozen ones, those at the start and velocities there.
        q: numbers.
        form: of the model.
        knots: of the curves.
        circuit: place of its numbers.
        sums: scratch.
        load: inertia, and factorised slopes of the stage's residual by y.
    """
    d_base, d_bristle, d_s, d_v = bases
    y, before, h, half = now
    n, unknown = len(before), len(y)
    nodes, columns = unknown - n, d_y.shape[1]
    p, rate = np.empty(nodes + 2), np.empty(nodes)
    p[:nodes] = y[:nodes]
    p[nodes], p[nodes + 1] = q[circuit + at.TANK], q[circuit + at.SUPPLY]
    _rates(stroke[0], h, q, form, circuit, rate)
    for node in range(nodes):
        for k in range(columns):
            d_y[node, k] = d_base[node, k]
    for m in range(len(flows)):
        for k in range(columns):
            d_y[2 * n + m, k] += rate[2 * n + m] * flows[m, k]
    _add_spools(spools, stroke[0], p, rate, q, form, knots, sums, d_y)
    for i in range(n):
        a, row = form[3][i], nodes + i
        by_before = h * friction(y[row], before[i], h, a, q)[3]
        reached = stroke[1][i] + half * (stroke[2][i] + y[row])
        inside = q[a + at.STOP_LOW] <= reached <= q[a + at.STOP_HIGH]
        touched = 0.0 if inside else h * q[a + at.STOP_STIFFNESS]
        for k in range(columns):
            d_y[row, k] = -by_before * d_bristle[i, k] - touched * (d_s[i, k] + half * d_v[i, k])
        for m in range(n):
            mass = load[0][i, m]
            for k in range(columns):
                d_y[row, k] += mass * d_base[nodes + m, k]
    solve(load[1], d_y)


@inner
def bristles_of_others(
    d_z: Array, d_base: Array, d_y: Array, y: Array, base: Array, h: float, q: Array, actuator_at: IntArray
) -> None:
    """Compute the differences of the bristles after a stage, from the differences of their base and of y."""
    nodes = len(y) - len(base)
    for i in range(len(base)):
        a = actuator_at[i]
        under = friction(y[nodes + i], base[i], h, a, q)[4]
        by_v = bristle_slopes(y[nodes + i], base[i], h, a, q)[0]
        for k in range(d_z.shape[1]):
            d_z[i, k] = under * d_base[i, k] + by_v * d_y[nodes + i, k]


@inner
def contents_of_others(d_y: Array, y: Array, nodes: int, q: Array, circuit: int, d_held: Array) -> None:
    """Differences of what pressures and velocities hold, see `stage.content`."""
    for node in range(nodes):
        slope = content(y[node], q[circuit + at.BULK], q[circuit + at.AIR])[1]
        for k in range(d_y.shape[1]):
            d_held[node, k] = slope * d_y[node, k]
    d_held[nodes:] = d_y[nodes:]


@inner
def hold_others(ports: IntArray, limits: tuple[Array, ...], y: Array, s: Array, d_y: Array, d_s: Array) -> None:
    """Hold the other runs at a bound where the first run is at this bound."""
    n = len(s)
    nodes = len(y) - n
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        index = which + (0 if kind == 2 else nodes)
        value = s[which] if kind == 1 else y[index]
        if limits[0][c] < value < limits[1][c]:
            continue
        d_y[index] = 0.0
        if kind == 1:
            d_s[which] = 0.0
