"""A recurrent cell on top of a grey box: it reads ports and the grey box's own change, and corrects that change.

    r, k = sigmoid(a + W x + U h),  n = tanh(a + W x + r (U h + b)),  h' = n + k (h - n),  change += c (V h' + d)

x are the ports as they were fed, then what the grey box changes velocities and pressures by in this tick; a is the
commands' part. Bounds, and strokes as integrals, come behind the correction.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey.jit import compiled, inner
from edp.networks.twin.grey.program import GreyProgram
from edp.networks.twin.steps import gates_back, gates_of

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Singles = NDArray[np.float32]
LARGEST = 1e3
"""Gradient by a state beyond which a lane's earlier ticks are left out: of a mean loss it only grows so in runs that
part from each other at the least change (a check that chatters, an end stop), where it says nothing."""


class OutputBounds(NamedTuple):
    """Least and largest outputs in units of the grey box, and these units in SI units, shape (output,)."""

    low: Array
    high: Array
    units: Array


class Cell(NamedTuple):
    """A network's part in the outputs; without units there is none.

    Attributes:
        projected: part of the commands in its gates, shape (tick, run, 3 * unit).
        state: h, moved, shape (run, unit).
        read_weight: of what it reads, shape (read, 3 * unit).
        state_weight: of h, shape (unit, 3 * unit).
        inner_bias: of n's inner sum, shape (unit,).
        out_weight: of its outputs, shape (unit, solved).
        out_bias: of its outputs, shape (solved,).
        offset: of what it reads, in units of the grey box, shape (output,).
        per_width: inverse width of what it reads, shape (output,).
        change: width of changes, in units of the grey box, shape (solved,).
        solved: outputs that it corrects, shape (solved,).
    """

    projected: Singles
    state: Singles
    read_weight: Singles
    state_weight: Singles
    inner_bias: Singles
    out_weight: Singles
    out_bias: Singles
    offset: Array
    per_width: Array
    change: Array
    solved: IntArray


class RunTrace(NamedTuple):
    """What a run leaves for its adjoint, tick first; without rows there is none.

    Attributes:
        read: what the cell read, shape (tick, run, read).
        free: 1 where no bound acted, shape (tick, run, output).
        gates: shape (tick, run, 3 * unit).
        inner_sum: shape (tick, run, unit).
        state: h, shape (tick + 1, run, unit).
        slopes: Jacobians of the grey box's ticks, shape (tick, run, state, state).
        counts: 1 where these count, shape (tick, run).
    """

    read: Singles
    free: Singles
    gates: Singles
    inner_sum: Singles
    state: Singles
    slopes: Singles
    counts: Singles


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
    now: tuple[int, int], y: Array, s: Array, fed: Array, ports: IntArray, cell: Cell, trace: RunTrace | None
) -> None:
    """Advance the cell of one run by one sample, and correct pressures and velocities.

    Args:
        now: sample and run.
        y: pressures and velocities as the grey box has them after the sample; moved.
        s: strokes.
        fed: what the ports read before it.
        ports: kind and number of the state behind each output.
        cell: moved.
        trace: written, unless None.
    """
    t, row = now
    units, answers, n, nodes = cell.state.shape[1], len(ports), len(s), len(y) - len(s)
    solved = cell.solved
    read, correction = np.empty(len(cell.read_weight), np.float32), np.empty(len(solved), np.float32)
    for c in range(answers):
        read[c] = (fed[c] - cell.offset[c]) * cell.per_width[c]
    for j in range(len(solved)):
        read[answers + j] = (y[index_of(ports[solved[j]], n, nodes)] - fed[solved[j]]) / cell.change[j]
    into, up = np.empty((1, 3 * units), np.float32), np.empty((1, 3 * units), np.float32)
    gates, inner_sum, new_h = np.empty_like(into), np.empty((1, units), np.float32), np.empty((1, units), np.float32)
    np.dot(read, cell.read_weight, into[0])
    np.dot(cell.state[row], cell.state_weight, up[0])
    for i in range(3 * units):
        into[0, i] += cell.projected[t, row, i]
    gates_of(into, up, cell.inner_bias, cell.state[row : row + 1], gates, inner_sum, new_h)
    np.dot(new_h[0], cell.out_weight, correction)
    for j in range(len(solved)):
        y[index_of(ports[solved[j]], n, nodes)] += (correction[j] + cell.out_bias[j]) * cell.change[j]
    if trace is not None:
        trace.read[t, row], trace.gates[t, row], trace.inner_sum[t, row] = read, gates[0], inner_sum[0]
        trace.state[t + 1, row] = new_h[0]
    cell.state[row] = new_h[0]


@inner
def note_bounds(
    now: tuple[int, int], y: Array, s: Array, ports: IntArray, bounds: OutputBounds, proposed: Array, trace: RunTrace
) -> None:
    """Record in the trace where no bound was active on an output, from the ports before bounding."""
    n, nodes = len(s), len(y) - len(s)
    for c in range(len(ports)):
        index = index_of(ports[c], n, nodes)
        if index < len(y):
            free = y[index] == proposed[c]
        else:
            free = bounds.low[c] < s[index - len(y)] < bounds.high[c]
        trace.free[now[0], now[1], c] = 1.0 if free else 0.0


@inner
def state_rows(program: GreyProgram) -> IntArray:
    """Return the places of the state on which a sample acts: unknowns, strokes, bristles and displacements."""
    (n, _, pumps, nodes, _), frame = program.sizes, program.frame
    rows, k = np.empty(nodes + 3 * n + pumps, np.int64), 0
    for first, count in ((0, nodes + n), (frame.strokes, n), (frame.bristles, n), (frame.displacements, pumps)):
        for row in range(first, first + count):
            rows[k] = row
            k += 1
    return rows


@inner
def seed(rows: IntArray, tangents: Array) -> None:
    """Set the tangents of the state by itself: one."""
    for row in range(tangents.shape[0]):
        for k in range(tangents.shape[1]):
            tangents[row, k] = 0.0
    for column in range(len(rows)):
        tangents[rows[column], column] = 1.0


@inner
def note_slopes(now: tuple[int, int], rows: IntArray, tangents: Array, trace: RunTrace) -> None:
    """Write the Jacobian of a sample by the state before it to the trace."""
    for row in range(len(rows)):
        for k in range(tangents.shape[1]):
            trace.slopes[now[0], now[1], row, k] = tangents[rows[row], k]
    trace.counts[now[0], now[1]] = 1.0


@compiled
def run_back(
    grad_answers: Singles,
    port: Singles,
    cell: Cell,
    ports: IntArray,
    sizes: tuple[int, int, float],
    trace: RunTrace,
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
    h, per_width, change, solved = cell.state, cell.per_width, cell.change, cell.solved
    by_gates, by_inner, by_out = grads
    ticks, lanes, answers = grad_answers.shape
    n, nodes, half = sizes
    width = trace.slopes.shape[2]
    read_up, h_up = np.ascontiguousarray(cell.read_weight.T), np.ascontiguousarray(cell.state_weight.T)
    out_up = np.ascontiguousarray(cell.out_weight.T)
    by_h, from_h, by_up = np.zeros_like(h), np.empty_like(h), np.empty_like(by_gates[0])
    by_read = np.empty((lanes, len(cell.read_weight)), np.float32)
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
                    along = by_state[row, where[c]] * trace.free[t, row, c]
                    by_tick[row, where[c]] = 0.0
                    by_fed[row, where[c]] += along
                    by_fed[row, speed] += along * half
                    by_tick[row, speed] += along * half
            for j in range(len(solved)):
                index = where[solved[j]]
                by_tick[row, index] *= trace.free[t, row, solved[j]]
                by_out[t, row, j] = by_tick[row, index] * change[j]
        np.dot(by_out[t], out_up, from_h)
        gates_back(by_h, from_h, trace.gates[t], trace.inner_sum[t], trace.state[t], (by_gates[t], by_inner[t], by_up))
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
            _before((t, row), port, where, trace, by_fed[row], by_tick[row], by_state[row])


@inner
def _before(
    now: tuple[int, int],
    port: Singles,
    where: IntArray,
    trace: RunTrace,
    by_fed: Array,
    by_tick: Array,
    by_state: Array,
) -> None:
    """Compute the gradient by the state before a sample from those by the fed values and the grey-box result."""
    (t, row) = now
    by_state[:] = 0.0
    if trace.counts[t, row] == 0.0:
        # All that was fed so far was measured: no weight has a part in it.
        return
    jacobian = trace.slopes[t, row]
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
