"""A recurrent cell on top of a grey box: it reads ports and the grey box's own change, and corrects that change.

    r, k = sigmoid(a + W x + U h),  n = tanh(a + W x + r (U h + b)),  h' = n + k (h - n),  change += c (V h' + d)

x are the ports as they were fed, then what the grey box changes velocities and pressures by in this tick; a is the
commands' part. Bounds, and strokes as integrals, come behind the correction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey.jit import compiled, inner
from edp.networks.twin.steps import gates_back, gates_of

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Singles = NDArray[np.float32]
LARGEST = 1e3
"""Gradient by a state beyond which a lane's earlier ticks are left out: of a mean loss it only grows so in runs that
part from each other at the least change (a check that chatters, an end stop), where it says nothing."""
Cell = tuple[Singles, Singles, Singles, Singles, Singles, Singles, Singles, Array, Array, Array, IntArray]
Trace = tuple[Singles, Singles, Singles, Singles, Singles, Singles, Singles]


@inner
def index_of(port: IntArray, n: int, nodes: int) -> Any:
    """Return the index of the state of a port among pressures, velocities and strokes."""
    return port[1] + (nodes if port[0] == 0 else (nodes + n if port[0] == 1 else 0))


@inner
def fed_ports(ports: IntArray, y: Array, s: Array, fed: Array) -> None:
    """Write the port readings, in units of the grey box, to `fed` ``(answer,)``."""
    n, nodes = len(s), len(y) - len(s)
    for c in range(len(ports)):
        index = index_of(ports[c], n, nodes)
        fed[c] = y[index] if index < len(y) else s[index - len(y)]


@inner
def correct(
    now: tuple[int, int], y: Array, s: Array, fed: Array, ports: IntArray, cell: Cell, trace: Trace, proposed: Array
) -> None:
    """Advance the cell of one run by one sample, and correct pressures and velocities.

    Args:
        now: tick and lane.
        y: pressures and velocities as the grey box has them after the tick; moved.
        s: strokes.
        fed: what the ports read before it.
        ports: kind and number of the state behind each answer.
        cell: of `run_lanes`.
        trace: of `run_lanes`.
        proposed: written: ports after the correction, before bounds act ``(answer,)``.
    """
    projected, h, read_weight, h_weight, inner_bias, out_weight, out_bias, offset, per_width, change, solved = cell
    t, row = now
    units, answers, n, nodes = h.shape[1], len(ports), len(s), len(y) - len(s)
    read, correction = np.empty(len(read_weight), np.float32), np.empty(len(solved), np.float32)
    for c in range(answers):
        read[c] = (fed[c] - offset[c]) * per_width[c]
    for j in range(len(solved)):
        read[answers + j] = (y[index_of(ports[solved[j]], n, nodes)] - fed[solved[j]]) / change[j]
    into, up = np.empty((1, 3 * units), np.float32), np.empty((1, 3 * units), np.float32)
    gates, inner_sum, new_h = np.empty_like(into), np.empty((1, units), np.float32), np.empty((1, units), np.float32)
    np.dot(read, read_weight, into[0])
    np.dot(h[row], h_weight, up[0])
    for i in range(3 * units):
        into[0, i] += projected[t, row, i]
    gates_of(into, up, inner_bias, h[row : row + 1], gates, inner_sum, new_h)
    np.dot(new_h[0], out_weight, correction)
    for j in range(len(solved)):
        y[index_of(ports[solved[j]], n, nodes)] += (correction[j] + out_bias[j]) * change[j]
    if len(trace[0]) > 0:
        trace[0][t, row], trace[2][t, row], trace[3][t, row] = read, gates[0], inner_sum[0]
        trace[4][t + 1, row] = new_h[0]
        fed_ports(ports, y, s, proposed)
    h[row] = new_h[0]


@inner
def note_bounds(
    now: tuple[int, int], y: Array, s: Array, ports: IntArray, limits: tuple[Array, ...], trace: Trace, proposed: Array
) -> None:
    """Record in the trace where no bound was active on an output, from the ports before bounding."""
    n, nodes = len(s), len(y) - len(s)
    for c in range(len(ports)):
        index = index_of(ports[c], n, nodes)
        if index < len(y):
            free = y[index] == proposed[c]
        else:
            free = limits[0][c] < s[index - len(y)] < limits[1][c]
        trace[1][now[0], now[1], c] = 1.0 if free else 0.0


@inner
def seed(tangents: tuple[Array, ...]) -> None:
    """Tangents by the state itself: one."""
    column = 0
    for values in tangents:
        values[:] = 0.0
        for i in range(len(values)):
            values[i, column] = 1.0
            column += 1


@inner
def note_slopes(now: tuple[int, int], tangents: tuple[Array, ...], trace: Trace) -> None:
    """Write the Jacobian of a tick by the state before it to the trace."""
    first = 0
    for values in tangents:
        trace[5][now[0], now[1], first : first + len(values)] = values
        first += len(values)
    trace[6][now[0], now[1]] = 1.0


@compiled
def run_back(
    grad_answers: Singles,
    port: Singles,
    cell: Cell,
    ports: IntArray,
    sizes: tuple[int, int, float],
    trace: Trace,
    grads: tuple[Singles, Singles, Singles],
) -> None:
    """Compute the adjoint of a free run of grey box and cell, from the last sample to the first.

    Args:
        grad_answers: gradient by the answers, each in its deviations ``(tick, lane, answer)``.
        port: 1 where a port read a measured value; the shape of `grad_answers`.
        cell: as in the forward run; `ports` and `trace` likewise.
        ports: of the grey box.
        sizes: actuators, nodes, and half a tick (s).
        trace: what the forward run wrote.
        grads: written: by the gates' pre-activations ``(tick, lane, 3 units)``, by n's inner sum ``(tick, lane,
            units)``, and by the cell's answers ``(tick, lane, solved)``.
    """
    _, h, read_weight, h_weight, _, out_weight, _, _, per_width, change, solved = cell
    by_gates, by_inner, by_out = grads
    ticks, lanes, answers = grad_answers.shape
    n, nodes, half = sizes
    width = trace[5].shape[2]
    read_up, h_up = np.ascontiguousarray(read_weight.T), np.ascontiguousarray(h_weight.T)
    out_up = np.ascontiguousarray(out_weight.T)
    by_h, from_h, by_up = np.zeros_like(h), np.empty_like(h), np.empty_like(by_gates[0])
    by_read = np.empty((lanes, len(read_weight)), np.float32)
    by_state, by_fed, by_tick = np.zeros((lanes, width)), np.zeros((lanes, width)), np.zeros((lanes, width))
    where = np.array([index_of(ports[c], n, nodes) for c in range(answers)])
    for t in range(ticks - 1, -1, -1):
        by_fed[:] = 0.0
        for row in range(lanes):
            for c in range(answers):
                by_state[row, where[c]] += grad_answers[t, row, c] * per_width[c]
            by_tick[row] = by_state[row]
            for c in range(answers):
                if ports[c, 0] == 1:
                    # A stroke is fed stroke plus trapezoid: the grey box's own is not read.
                    speed = nodes + ports[c, 1]
                    along = by_state[row, where[c]] * trace[1][t, row, c]
                    by_tick[row, where[c]] = 0.0
                    by_fed[row, where[c]] += along
                    by_fed[row, speed] += along * half
                    by_tick[row, speed] += along * half
            for j in range(len(solved)):
                index = where[solved[j]]
                by_tick[row, index] *= trace[1][t, row, solved[j]]
                by_out[t, row, j] = by_tick[row, index] * change[j]
        np.dot(by_out[t], out_up, from_h)
        gates_back(by_h, from_h, trace[2][t], trace[3][t], trace[4][t], (by_gates[t], by_inner[t], by_up))
        np.dot(by_up, h_up, from_h)
        np.dot(by_gates[t], read_up, by_read)
        by_h += from_h
        for row in range(lanes):
            for c in range(answers):
                by_fed[row, where[c]] += by_read[row, c] * per_width[c]
            for j in range(len(solved)):
                along = by_read[row, answers + j] / change[j]
                by_tick[row, where[solved[j]]] += along
                by_fed[row, where[solved[j]]] -= along
            _before(t, row, port, where, trace, by_fed[row], by_tick[row], by_state[row])


@inner
def _before(
    t: int, row: int, port: Singles, where: IntArray, trace: Trace, by_fed: Array, by_tick: Array, by_state: Array
) -> None:
    """Compute the gradient by the state before a sample from those by the fed values and the grey-box result."""
    by_state[:] = 0.0
    if trace[6][t, row] == 0.0:
        # All that was fed so far was measured: no weight has a part in it.
        return
    jacobian = trace[5][t, row]
    for k in range(len(by_state)):
        by_state[k] += by_fed[k]
        if by_tick[k] != 0.0:
            for i in range(len(by_state)):
                by_state[i] += jacobian[k, i] * by_tick[k]
    for c in range(len(where)):
        if port[t, row, c] > 0:
            by_state[where[c]] = 0.0
    for k in range(len(by_state)):
        if not abs(by_state[k]) <= LARGEST:
            by_state[:] = 0.0
            return
