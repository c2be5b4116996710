"""Recurrent cell that corrects the change of a grey box in each sample, and the adjoint of a corrected run.

    r, k = sigmoid(a + W x + U h),  n = tanh(a + W x + r (U h + b)),  h' = n + k (h - n),  change += c (V h' + d)

The input x consists of the port readings and of the change of velocities and pressures in the grey box; a is the
contribution of the commands. Bounds and the integration of strokes follow the correction.
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
"""Maximum gradient by a state. For a larger gradient, the earlier samples of the run are omitted. The gradient of a
mean loss becomes this large only in chaotic simulations (a chattering check valve, an end stop), where it has no
meaning."""


class OutputBounds(NamedTuple):
    """Bounds of the outputs in units of the grey box, and those units in SI units, shape (output,)."""

    low: Array
    high: Array
    units: Array


class Cell(NamedTuple):
    """Weights and state of the recurrent cell; a twin without a correction has a cell of zero units.

    Attributes:
        projected: contribution of the commands to the gates, shape (sample, run, 3 * unit).
        state: hidden state h, updated in place, shape (run, unit).
        read_weight: input weights W, shape (input, 3 * unit).
        state_weight: recurrent weights U, shape (unit, 3 * unit).
        inner_bias: bias b, shape (unit,).
        out_weight: output weights V, shape (unit, corrected output).
        out_bias: output bias d, shape (corrected output,).
        offset: offset of the port readings, in units of the grey box, shape (output,).
        per_width: inverse scale of the port readings, shape (output,).
        change: scale c of the changes, in units of the grey box, shape (corrected output,).
        solved: indices of the corrected outputs, shape (corrected output,).
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
    """Intermediate values of a run that its adjoint needs; arrays of length zero disable the recording.

    Attributes:
        read: inputs of the cell, shape (sample, run, input).
        free: 1 where no bound was active, shape (sample, run, output).
        gates: gates of the cell, shape (sample, run, 3 * unit).
        inner_sum: inner sum of n, shape (sample, run, unit).
        state: hidden state h, shape (sample + 1, run, unit).
        slopes: Jacobians of the samples of the grey box, shape (sample, run, state, state).
        counts: 1 where the Jacobian was recorded, shape (sample, run).
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
def read_ports(ports: IntArray, y: Array, s: Array, fed: Array) -> None:
    """Write the port readings to `fed`, in units of the grey box, shape (output,)."""
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
        y: pressures and velocities of the grey box after the sample; corrected in place.
        s: strokes.
        fed: port readings before the sample.
        ports: kind and index of the state behind each output.
        cell: recurrent cell; its state is updated in place.
        trace: record of the run, updated in place, or None.
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
    """Record in the trace which outputs were not bounded."""
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
    """Return the indices of the state variables of a sample: unknowns, strokes, bristles and displacements."""
    sizes = program.sizes
    n, pumps, nodes, frame = sizes.actuators, sizes.pumps, sizes.nodes, program.frame
    rows, k = np.empty(nodes + 3 * n + pumps, np.int64), 0
    for first, count in ((0, nodes + n), (frame.strokes, n), (frame.bristles, n), (frame.displacements, pumps)):
        for row in range(first, first + count):
            rows[k] = row
            k += 1
    return rows


@inner
def seed(rows: IntArray, tangents: Array) -> None:
    """Initialise the tangents with the derivatives of the state by itself: the identity matrix."""
    for row in range(tangents.shape[0]):
        for k in range(tangents.shape[1]):
            tangents[row, k] = 0.0
    for column in range(len(rows)):
        tangents[rows[column], column] = 1.0


@inner
def note_slopes(now: tuple[int, int], rows: IntArray, tangents: Array, trace: RunTrace) -> None:
    """Record the Jacobian of a sample by the state before the sample."""
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
        grad_answers: gradient by the scaled outputs, shape (sample, run, output).
        port: 1 where a port read a measured value, shape (sample, run, output).
        cell: cell of the forward run.
        ports: kind and index of the state behind each output.
        sizes: numbers of actuators and of nodes, and half a sample time (s).
        trace: record of the forward run.
        grads: gradients, written in place: by the pre-activations of the gates, shape (sample, run, 3 * unit), by the
            inner sum of n, shape (sample, run, unit), and by the outputs of the cell, shape (sample, run, corrected
            output).
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
                    # A stroke is the fed stroke plus the trapezoidal integral; the result of the grey box is not used.
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
            _propagate_back((t, row), port, where, trace, by_fed[row], by_tick[row], by_state[row])


@inner
def _propagate_back(
    now: tuple[int, int],
    port: Singles,
    where: IntArray,
    trace: RunTrace,
    by_fed: Array,
    by_tick: Array,
    by_state: Array,
) -> None:
    """Compute the gradient with respect to the previous state from the gradients of feedback values and grey box."""
    (t, row) = now
    by_state[:] = 0.0
    if trace.counts[t, row] == 0.0:
        # All port readings so far were measured, so they do not depend on the weights.
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
