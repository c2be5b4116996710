"""The hydraulic network of a grey box: what flows into each node, and the derivatives of that.

    Q = a dp / (dp^2 + delta^2)^(1/4)

Edges are stamped into the sums of their two nodes, as in circuit simulation. The pressures of tank and supply are
nodes too, so that the derivatives by both come with those by all others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.jit import inlined, inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
SMOOTH2 = 0.1**2
"""Square of the pressure (MPa) below which an orifice turns laminar."""
CHECK = 1e-3
"""Share of its flow that a load check passes backwards: not zero, so that a closed check has a slope."""


@inlined
def turbulent(dp: float) -> tuple[float, float]:
    """Smoothed square root of a pressure difference, and its slope."""
    q2 = dp * dp + SMOOTH2
    root = math.sqrt(math.sqrt(q2))
    inverse = 1.0 / (q2 * root)
    return dp * q2 * inverse, (q2 - 0.5 * dp * dp) * inverse


@inlined
def stamp(f: int, t: int, flow: float, slope: float, net: Array, jac: Array) -> None:
    """Add an edge that passes `flow` from node `f` to node `t`, with its slope by the pressure difference."""
    net[f] -= flow
    net[t] += flow
    jac[f, f] -= slope
    jac[f, t] += slope
    jac[t, f] += slope
    jac[t, t] -= slope


@inlined
def opening(r: float, first: int, q: Array, knots: Array) -> tuple[float, float]:
    """Area of a monotone curve at r in [0, 1] and its slope: increments between fixed knots, summed up."""
    area, slope = 0.0, 0.0
    for k in range(len(knots) - 1):
        width = knots[k + 1] - knots[k]
        share = (r - knots[k]) / width
        if share >= 1.0:
            area += q[first + k]
        elif share > 0.0:
            area += q[first + k] * share
            slope = q[first + k] / width
    return area, slope


@inlined
def cushion(distance: float, length: float, least: float) -> tuple[float, float, float, float]:
    """Share of the outflow left at a distance from the stop: a smoothstep; its slopes by the three arguments."""
    r = distance / length
    if r >= 1.0:
        return 1.0, 0.0, 0.0, 0.0
    r = max(r, 0.0)
    step = r * r * (3.0 - 2.0 * r)
    slope = (1.0 - least) * 6.0 * r * (1.0 - r) / length
    return least + (1.0 - least) * step, slope, -slope * r, 1.0 - step


@inner
def edge(
    f: int,
    t: int,
    where: tuple[int, int, int],
    weight: tuple[float, float, float, float],
    checked: bool,
    q: Array,
    p: Array,
    knots: Array,
    sums: tuple[Array, ...],
    full: bool,
) -> float:
    """One opening of a spool.

    Args:
        f: node that it passes from; `t` the one that it passes to.
        t: node.
        where: of the curve's first increment, of the dead band, and the valve's number.
        weight: r, its slopes by spool and dead band, and the factor on the area.
        checked: whether a load check bars the way back.
        q: numbers; `p` pressures of the nodes.
        p: pressures.
        knots: of the curve.
        sums: net flows, their slopes by pressure, by spool, by stroke and by number.
        full: whether slopes beside those by pressure are wanted.

    Returns:
        Flow at a factor of one.
    """
    net, jac, net_x, _, net_q = sums
    first, band, j = where
    r, by_x, by_band, factor = weight
    area, slope = opening(r, first, q, knots)
    g, g_slope = turbulent(p[f] - p[t])
    if checked and p[f] < p[t]:
        g, g_slope = CHECK * g, CHECK * g_slope
    stamp(f, t, factor * area * g, factor * area * g_slope, net, jac)
    if full:
        along = factor * slope * g
        net_x[f, j] -= along * by_x
        net_x[t, j] += along * by_x
        net_q[f, band] -= along * by_band
        net_q[t, band] += along * by_band
        for k in range(len(knots) - 1):
            share = min(max((r - knots[k]) / (knots[k + 1] - knots[k]), 0.0), 1.0) * factor * g
            net_q[f, first + k] -= share
            net_q[t, first + k] += share
    return area * g


@inner
def valve_flows(
    x: Array,
    strokes: Array,
    q: Array,
    p: Array,
    form: tuple[IntArray, ...],
    knots: Array,
    sums: tuple[Array, ...],
    full: bool,
) -> None:
    """Stamp the edges of all spools at positions `x` ``(valve,)`` and strokes (m)."""
    valve_at, valve_actuator, valve_pump, actuator_at, _ = form
    n, supply = len(actuator_at), len(p) - 1
    net_s, net_q = sums[3], sums[4]
    for j in range(len(x)):
        i, d = valve_actuator[j], (0 if x[j] >= 0.0 else 1)
        band = valve_at[j, at.BAND + d]
        closed = 1.0 / (1.0 - q[band])
        r = (abs(x[j]) - q[band]) * closed
        if r <= 0.0:
            continue
        by_x, by_band = (closed if d == 0 else -closed), (r - 1.0) * closed
        if r >= 1.0:
            r, by_x, by_band = 1.0, 0.0, 0.0
        fed, other = (i, n + i) if d == 0 else (n + i, i)
        source = 2 * n + valve_pump[j] if valve_pump[j] >= 0 else supply
        edge(source, fed, (valve_at[j, at.INTO + d], band, j), (r, by_x, by_band, 1.0), True, q, p, knots, sums, full)
        out = valve_at[j, at.OUT_OF + d]
        if out < 0:
            continue
        # Cushions throttle what leaves, on the side that the piston runs into.
        a = actuator_at[i]
        left = q[a + at.STOP_HIGH] - strokes[i] if d == 0 else strokes[i] - q[a + at.STOP_LOW]
        share, by_left, by_length, by_least = cushion(left, q[a + at.CUSHION_LENGTH], q[a + at.CUSHION_LEAST])
        tank = len(p) - 2
        again = valve_at[j, at.REGENERATION + d]
        for way in range(2 if again >= 0 else 1):
            to, gain = (tank, 1.0) if way == 0 else (fed, q[again])
            whole = edge(other, to, (out, band, j), (r, by_x, by_band, share * gain), way == 1, q, p, knots, sums, full)
            if full:
                toward = 1.0 if d == 1 else -1.0
                stop = a + (at.STOP_LOW if d == 1 else at.STOP_HIGH)
                for node, sign in ((other, -1.0), (to, 1.0)):
                    flow = sign * gain * whole
                    net_s[node, i] += flow * by_left * toward
                    net_q[node, stop] -= flow * by_left * toward
                    net_q[node, a + at.CUSHION_LENGTH] += flow * by_length
                    net_q[node, a + at.CUSHION_LEAST] += flow * by_least
                    if way == 1:
                        net_q[node, again] += sign * share * whole


@inner
def port_flows(
    q: Array, p: Array, form: tuple[IntArray, ...], circuit: int, sums: tuple[Array, ...], full: bool
) -> None:
    """Stamp leakage, reliefs and make-up of all chambers."""
    actuator_at = form[3]
    net, jac, _, _, net_q = sums
    n, tank = len(actuator_at), len(p) - 2
    for i in range(n):
        a = actuator_at[i]
        leak = q[a + at.PISTON_LEAK]
        stamp(i, n + i, leak * (p[i] - p[n + i]), leak, net, jac)
        for side in range(2):
            node, relief = i + side * n, a + at.HEAD_RELIEF + side
            spool = q[a + at.SPOOL_LEAK]
            stamp(node, tank, spool * (p[node] - p[tank]), spool, net, jac)
            over = max(p[node] - q[relief], 0.0)
            # A slope instead of a hard limit: real reliefs let pressure rise while they open.
            opened = q[circuit + at.PORT_SLOPE]
            net[node] -= opened * over
            jac[node, node] -= opened if over > 0.0 else 0.0
            g, slope = turbulent(max(p[tank] - p[node], 0.0))
            make_up = q[circuit + at.MAKE_UP]
            if p[node] < p[tank]:
                stamp(tank, node, make_up * g, make_up * slope, net, jac)
            if full:
                net_q[node, a + at.SPOOL_LEAK] -= p[node] - p[tank]
                net_q[node, relief] += opened if over > 0.0 else 0.0
                net_q[node, circuit + at.PORT_SLOPE] -= over
                net_q[node, circuit + at.MAKE_UP] += g
        if full:
            net_q[i, a + at.PISTON_LEAK] -= p[i] - p[n + i]
            net_q[n + i, a + at.PISTON_LEAK] += p[i] - p[n + i]


@inner
def pump_flows(
    x: Array,
    displacement: Array,
    q: Array,
    p: Array,
    form: tuple[IntArray, ...],
    circuit: int,
    sums: tuple[Array, ...],
    full: bool,
) -> None:
    """Stamp pumps, open centres, which close as any spool of a pump moves, and main reliefs."""
    _, _, valve_pump, actuator_at, pump_at = form
    net, jac, net_x, _, net_q = sums
    first, tank = 2 * len(actuator_at), len(p) - 2
    for m in range(len(pump_at)):
        a, node = pump_at[m], first + m
        net[node] += q[a + at.FLOW] * displacement[m]
        closed = 1.0 / q[a + at.BYPASS_CLOSED]
        area = q[a + at.BYPASS]
        for j in range(len(x)):
            if valve_pump[j] == m:
                left = max(1.0 - abs(x[j]) * closed, 0.0)
                area *= left * left
        g, slope = turbulent(p[node] - p[tank])
        stamp(node, tank, area * g, area * slope, net, jac)
        over = max(p[node] - q[a + at.RELIEF], 0.0)
        opened = q[circuit + at.RELIEF_SLOPE]
        net[node] -= opened * over
        jac[node, node] -= opened if over > 0.0 else 0.0
        if full:
            net_q[node, a + at.FLOW] += displacement[m]
            net_q[node, a + at.BYPASS] -= area / q[a + at.BYPASS] * g
            net_q[node, a + at.RELIEF] += opened if over > 0.0 else 0.0
            net_q[node, circuit + at.RELIEF_SLOPE] -= over
            if area > 0.0:
                for j in range(len(x)):
                    if valve_pump[j] == m:
                        shrink = -2.0 * area * closed / (1.0 - abs(x[j]) * closed)
                        net_x[node, j] -= g * shrink * (1.0 if x[j] >= 0.0 else -1.0)
                        net_q[node, a + at.BYPASS_CLOSED] += g * shrink * abs(x[j]) * closed
