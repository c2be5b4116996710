"""Batched simulation of grey boxes: free runs with measured ports, and the normal equations of a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import layout as at
from edp.networks.twin.grey.correction import Cell, Trace, correct, fed_ports, note_bounds, note_slopes, seed
from edp.networks.twin.grey.jit import compiled, inner
from edp.networks.twin.grey.steps import GAMMA, bristles, tick
from edp.networks.twin.grey.valve import advance_valves, displace

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@inner
def work_arrays(
    n: int, nodes: int, pumps: int, valves: int, numbers: int, columns: int, terms: int, degree: int
) -> tuple[tuple[Array, ...], ...]:
    """Arrays that a tick writes: network sums, rows, load, monomials, vectors, matrices; and tangents."""
    unknown = nodes + n
    sums = (
        np.zeros(nodes + 2), np.zeros((nodes + 2, nodes + 2)), np.zeros((nodes + 2, valves)),
        np.zeros((nodes + 2, n)), np.zeros((nodes + 2, numbers)),
    )  # fmt: skip
    out = (
        np.zeros(unknown), np.zeros((unknown, unknown)), np.zeros((unknown, valves)), np.zeros((unknown, n)),
        np.zeros((unknown, pumps)), np.zeros((unknown, numbers)),
    )  # fmt: skip
    loads = (
        np.zeros(n), np.zeros((n, n)), np.zeros((n, n, n)), np.zeros((n, n)), np.zeros((n, n)),
        np.zeros((n, numbers)), np.zeros((3, n, degree + 1)), np.zeros((terms, n, n)),
        np.zeros((n, n)), np.zeros((n, n, n)), np.zeros((at.BASE, n, n)),
        np.zeros((at.BASE, at.BODIES * at.BODY_VALUES)),
    )  # fmt: skip
    monomials = (np.zeros(terms), np.zeros((terms, n)))
    vectors = (
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(unknown), np.zeros(n), np.zeros(unknown), np.zeros(n),
        np.zeros(unknown),
    )  # fmt: skip
    matrices = (
        np.zeros((n, columns)), np.zeros((unknown, columns)), np.zeros((n, columns)), np.zeros((unknown, columns)),
        np.zeros((n, columns)), np.zeros((unknown, columns)),
    )  # fmt: skip
    tangents = (
        np.zeros((unknown, columns)), np.zeros((n, columns)), np.zeros((n, columns)), np.zeros((pumps, columns)),
    )  # fmt: skip
    return sums, out, loads, monomials, vectors, matrices, tangents


@inner
def _set_port(kind: int, which: int, value: float, y: Array, s: Array, nodes: int) -> None:
    """Write a measured velocity (0), stroke (1) or pressure (2) in index of the state."""
    if kind == 1:
        s[which] = value
    elif kind == 0:
        y[nodes + which] = value
    else:
        y[which] = max(value, at.LEAST_ABSOLUTE - at.ATMOSPHERE)


@inner
def _follow(
    lane: tuple[Array, ...],
    tangents: tuple[Array, ...],
    history: Array,
    q: Array,
    form: tuple[IntArray, ...],
    circuit: int,
    tick_s: float,
    columns_by: int,
) -> None:
    """Advance a sample with fully measured load: only valves, displacements and bristles move."""
    y, s, z, d, valves = lane
    t_y, _, t_z, t_d, t_valves = tangents
    n, nodes = len(s), len(y) - len(s)
    advance_valves(valves, t_valves, history, GAMMA * tick_s, tick_s, q, form[0], circuit + at.PLAY)
    displace(d, t_d, valves, t_valves, (y[2 * n : nodes], t_y[2 * n : nodes]), tick_s, q, form, circuit, columns_by)
    advance_valves(valves, t_valves, history, (1.0 - GAMMA) * tick_s, tick_s, q, form[0], circuit + at.PLAY)
    bristles(y, z.copy(), tick_s, q, form[3], z, (t_z, t_z.copy(), t_y), columns_by)


@inner
def hold_bounds(
    y: Array, s: Array, before: tuple[Array, Array], ports: IntArray, limits: tuple[Array, ...], tick_s: float
) -> None:
    """Limit the outputs to their bounds: first velocities, then strokes; no velocity into an end stop."""
    nodes = len(y) - len(s)
    for turn in range(2):
        for c in range(len(ports)):
            kind, which = ports[c, 0], ports[c, 1]
            if (kind == 1) != (turn == 1):
                continue
            low, high = limits[0][c], limits[1][c]
            if kind == 1:
                value = before[0][which] + 0.5 * tick_s * (before[1][which] + y[nodes + which])
                s[which] = min(max(value, low), high)
                speed = y[nodes + which]
                y[nodes + which] = min(speed, 0.0) if value > high else (max(speed, 0.0) if value < low else speed)
            else:
                index = which + (nodes if kind == 0 else 0)
                y[index] = min(max(y[index], low), high)


@inner
def feed(
    measured: Array,
    answer: Array,
    fed_back: bool,
    ports: IntArray,
    state: tuple[Array, Array],
    tangents: tuple[Array, Array],
    full: bool,
) -> None:
    """Fill the ports with the measurement, or with the last output where the state was rounded to it."""
    y, s = state
    nodes = len(y) - len(s)
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        if np.isfinite(measured[c]):
            _set_port(kind, which, measured[c], y, s, nodes)
            if full and kind == 1:
                tangents[1][which] = 0.0
            elif full:
                tangents[0][which + (nodes if kind == 0 else 0)] = 0.0
        elif fed_back:
            _set_port(kind, which, answer[c], y, s, nodes)


@inner
def _row(
    truth: Array,
    errors_of: tuple[Array, float],
    ports: IntArray,
    state: tuple[Array, Array],
    tangents: tuple[Array, Array],
    full: bool,
    part: tuple[Array, Array],
) -> float:
    """Huber loss of one tick; its weighted errors and their slopes into `part`, if `full`."""
    (weight, delta), (y, s), (t_y, t_s) = errors_of, state, tangents
    nodes = len(y) - len(s)
    loss = 0.0
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        index = which + (nodes if kind == 0 else 0)
        error = weight[c] * ((s[which] if kind == 1 else y[index]) - truth[c])
        size = abs(error)
        loss += 0.5 * error * error if size <= delta else delta * (size - 0.5 * delta)
        if full:
            # Rows beyond delta count as much as their gradient says (iteratively reweighted least squares).
            share = 1.0 if size <= delta else np.sqrt(delta / size)
            part[1][c] = share * error
            for k in range(t_y.shape[1]):
                part[0][c, k] = share * weight[c] * (t_s[which, k] if kind == 1 else t_y[index, k])
    return loss


@compiled
def run_lanes(
    demands: Array,
    measured: Array,
    truth: Array,
    state: tuple[Array, ...],
    counts: tuple[int, int, int],
    errors_of: tuple[Array, float],
    limits: tuple[Array, Array, Array],
    model: tuple[Array, ...],
    form: tuple[IntArray, ...],
    ports: IntArray,
    places: tuple[int, int, int, int],
    exponents: IntArray,
    time: tuple[float, int],
    full: bool,
    answers: Array,
    normal: tuple[Array, Array, Array],
    cell: Cell,
    trace: Trace,
) -> None:
    """Simulate a batch, each port measured or fed back; optionally with losses, gradient and Gauss-Newton matrix.

    Args:
        demands: of the valves ``(lane, tick, valve)``.
        measured: in units of the grey box ``(lane, tick, answer)``, NaN where a port is free.
        truth: what the answers should be, of that shape; empty: answers are bounded and rounded, as a twin's are, and
            nothing is summed up.
        state: moved, lane first: answers, y, strokes, bristles, displacements, valves and history.
        counts: ticks of the prefix, whose errors do not count; those of it that need no load, as all of it is measured;
            ticks from one row that counts to the next.
        errors_of: weight of each answer's error, and where the Huber loss turns to a line.
        limits: least and largest answers, and their units in SI units.
        model: numbers, knots, middle and scale of the strokes, and a known linkage, as `layout` orders it.
        form: places of valves and elements.
        ports: kind and number of the state behind each answer ``(answer, 2)``.
        places: of coefficients and circuit.
        exponents: of the load.
        time: tick (s) and steps in it.
        full: whether gradient and matrix are wanted.
        answers: written ``(lane, tick, answer)``.
        normal: matrix ``(number, number)`` and gradient ``(number,)``, added to, and losses ``(lane,)``, written.
        cell: a network's part in what is answered; without units there is none. The commands' part of its gates
            ``(tick, lane, 3 units)``; h ``(lane, units)``, moved; weights of what it reads ``(read, 3 units)``, of h
            ``(units, 3 units)``, bias of n's inner sum ``(units,)``, weights ``(units, solved)`` and bias of what it
            answers; offset and inverse width of what it reads ``(answer,)`` and width of changes ``(solved,)``, in
            units of the grey box; and which answers it corrects ``(solved,)``.
        trace: written for `run_back`, unless empty: what the cell read, where no bound acted, gates, inner sums, h
            ``(tick + 1, lane, units)``, Jacobians of the grey box's ticks ``(tick, lane, state, state)``, and where
            these count ``(tick, lane)``; all tick first.
    """
    q = model[0]
    prefix, followed, stride = counts
    n, unknown, ticks = state[2].shape[1], state[1].shape[1], demands.shape[1]
    nodes, judged, traced = unknown - n, len(truth) > 0, len(trace[0]) > 0
    numbers = len(q) if full or traced else 0
    columns = trace[5].shape[2] if traced else numbers
    work = work_arrays(
        n, nodes, state[4].shape[1], state[5].shape[1], numbers, columns, len(exponents), exponents.max()
    )
    scratch = (work[0], work[1], work[2], work[3], work[4], work[5])
    own = np.zeros((state[5].shape[1], at.VALVE_STATES, at.OWN))
    t_y, t_s = work[6][0], work[6][1]
    tangents = (t_y, t_s, work[6][2], work[6][3], own)
    rows = ((ticks - prefix) // stride + 2) * len(ports) if full else 0
    slopes, errors = np.zeros((rows, columns)), np.zeros(rows)
    before = (np.zeros(n), np.zeros(n), np.zeros(len(ports)), np.zeros(len(ports)))
    wiring = (ports, limits, time[0])
    for row in range(len(demands)):
        y, s, history = state[1][row], state[2][row], state[6][row]
        lane = (y, s, state[3][row], state[4][row], state[5][row])
        for values in work[6]:
            values[:] = 0.0
        own[:] = 0.0
        loss, used, by_weights = 0.0, 0, False
        for t in range(ticks):
            feed(measured[row, t], state[0][row], not judged, ports, (y, s), (t_y, t_s), full)
            for k in range(len(history) - 1, 0, -1):
                history[k] = history[k - 1]
            history[0] = demands[row, t]
            if t < followed:
                _follow(lane, tangents, history, q, form, places[3], time[0], at.BY_NUMBERS if full else at.NONE)
                continue
            before[0][:], before[1][:] = s, y[nodes:]
            columns_by = at.BY_NUMBERS if full else at.NONE
            if traced:
                by_weights = by_weights or not np.isfinite(measured[row, t]).all()
                columns_by = at.BY_STATE if by_weights else at.NONE
                seed((t_y, t_s, work[6][2], work[6][3]))
            fed_ports(ports, y, s, before[2])
            tick(lane, tangents, history, model, form, places, exponents, time, scratch, columns_by)
            if by_weights:
                note_slopes((t, row), (t_y, t_s, work[6][2], work[6][3]), trace)
            if not judged:
                _answer((t, row), lane, history, before, wiring, (answers[row, t], state[0][row]), cell, trace)
                continue
            done = t + 1 - prefix
            if done <= 0 or (done % stride and t + 1 != ticks):
                continue
            part = (slopes[used : used + len(ports)], errors[used : used + len(ports)])
            loss += _row(truth[row, t], errors_of, ports, (y, s), (t_y, t_s), full, part)
            used += len(ports) if full else 0
        if judged:
            normal[2][row] = loss
        if full and np.isfinite(loss):
            counted = slopes[:used]
            normal[0][:] += np.dot(counted.T, counted)
            normal[1][:] += np.dot(counted.T, errors[:used])


@inner
def _answer(
    now: tuple[int, int],
    lane: tuple[Array, ...],
    history: Array,
    before: tuple[Array, Array, Array, Array],
    wiring: tuple[IntArray, tuple[Array, Array, Array], float],
    out: tuple[Array, Array],
    cell: Cell,
    trace: Trace,
) -> None:
    """Compute the twin's outputs after a sample: corrected, bounded, rounded; and the next port readings.

    Args:
        now: tick and lane.
        lane: state after the tick; moved.
        history: of the demands.
        before: strokes, velocities and ports before the tick; the last one is written.
        wiring: ports, limits, and length of a tick (s).
        out: written: answers in SI units, and in units of the grey box.
        cell: of `run_lanes`.
        trace: of `run_lanes`.
    """
    ports, limits, tick_s = wiring
    y, s, nodes = lane[0], lane[1], len(lane[0]) - len(lane[1])
    if cell[1].shape[1] > 0:
        correct(now, y, s, before[2], ports, cell, trace, before[3])
    hold_bounds(y, s, (before[0], before[1]), ports, limits, tick_s)
    if len(trace[0]) > 0:
        note_bounds(now, y, s, ports, limits, trace, before[3])
    _rounded(lane, history)
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        value = s[which] if kind == 1 else y[which + (nodes if kind == 0 else 0)]
        # Answers are kept as they go out: single precision, SI units.
        answer = np.float32(value * limits[2][c])
        out[0][c] = answer
        out[1][c] = answer / limits[2][c]


@inner
def _rounded(lane: tuple[Array, ...], history: Array) -> None:
    """Keep a state as single precision would, so that a chunk and its ticks give the same bits."""
    y, s, z, d, valves = lane
    y[:], s[:], z[:], d[:] = y.astype(np.float32), s.astype(np.float32), z.astype(np.float32), d.astype(np.float32)
    valves[:], history[:] = valves.astype(np.float32), history.astype(np.float32)
