"""A recurrent twin over time, forward and backward by hand, compiled: feedback makes every tick wait for the last one.

One loop over the ticks, without Python and without a graph. The caller computes the parts without feedback: the
commands' part of the gates before the loop, and the gradients of the weights after the loop. Everything is in scaled
numbers, float32.

The cell is PyTorch's GRU with feedback ports: at each tick it reads f, measured values or the last outputs, and outputs
with f plus its change::

    r, k = sigmoid(a + W f + U h),  n = tanh(a + W f + r (U h + b)),  h' = n + k (h - n)
    velocity = clip(f + c o + p (m - f)),  pressure likewise,  o = V h' + d
    stroke = clip(f + trapezoid (velocity before + velocity)), and no velocity into an end stop

If a twin has a static map, m is the output of the map for the commands, and p is the fraction of the distance to m by
which an output is pulled per sample; otherwise p is zero.

All compiled code of a twin is in this file. A hash of the file identifies the compiled code on disk.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.storage.machine_code import Compiler

Array = NDArray[np.float32]

compiler = Compiler("twin", lambda: (Path(__file__),))


@compiler.compiled
def _tanh(x: np.float32) -> np.float32:
    """Return the rational approximation of tanh used by Eigen and XLA, within 3e-7.

    It is vectorised, unlike libm's function.
    """
    bounded = min(max(x, np.float32(-7.90531110763549805)), np.float32(7.90531110763549805))
    square = bounded * bounded
    top = square * np.float32(-2.76076847742355e-16) + np.float32(2.00018790482477e-13)
    top = square * top + np.float32(-8.60467152213735e-11)
    top = square * top + np.float32(5.12229709037114e-08)
    top = square * top + np.float32(1.48572235717979e-05)
    top = square * top + np.float32(6.37261928875436e-04)
    top = square * top + np.float32(4.89352455891786e-03)
    under = square * np.float32(1.19825839466702e-06) + np.float32(1.18534705686654e-04)
    under = square * under + np.float32(2.26843463243900e-03)
    under = square * under + np.float32(4.89352518554385e-03)
    return np.float32(bounded * top / under)


@compiler.compiled
def gates_of(into: Array, up: Array, bias: Array, h: Array, gates: Array, inner: Array, new_h: Array) -> None:
    """Compute gates r, k, n ``(batch, 3 units)``, ``inner = U h + b`` of n, and the next h."""
    batch, units = h.shape
    half = np.float32(0.5)
    for row in range(batch):
        for i in range(2 * units):
            gates[row, i] = half * _tanh(half * (into[row, i] + up[row, i])) + half
        for i in range(units):
            inner[row, i] = up[row, 2 * units + i] + bias[i]
        for i in range(units):
            gates[row, 2 * units + i] = _tanh(into[row, 2 * units + i] + gates[row, i] * inner[row, i])
        for i in range(units):
            new = gates[row, 2 * units + i]
            new_h[row, i] = new + gates[row, units + i] * (h[row, i] - new)


@compiler.compiled
def _answer(fed: Array, change: Array, bounds: tuple[Array, ...], velocities: int, answer: Array, free: Array) -> None:
    """Compute outputs within the bounds, and a mask of inactive bounds ``(batch, output)``."""
    batch, answers = fed.shape
    _, low, high, trapezoid = bounds
    strokes = len(trapezoid)
    for row in range(batch):
        for j in range(answers):
            if velocities <= j < velocities + strokes:
                continue
            value = fed[row, j] + change[row, j]
            bounded = min(max(value, low[j]), high[j])
            answer[row, j] = bounded
            free[row, j] = 1.0 if bounded == value else 0.0
        for j in range(strokes):
            s = velocities + j
            value = fed[row, s] + trapezoid[j] * (fed[row, j] + answer[row, j])
            bounded = min(max(value, low[s]), high[s])
            answer[row, s] = bounded
            free[row, s] = 1.0 if bounded == value else 0.0
            into_stop = (value > high[s] and answer[row, j] > 0) or (value < low[s] and answer[row, j] < 0)
            if into_stop:
                answer[row, j] = 0.0
                free[row, j] = 0.0


@compiler.compiled
def run_forward(
    inputs: tuple[Array, ...],
    weights: tuple[Array, ...],
    bounds: tuple[Array, ...],
    velocities: int,
    start: tuple[Array, Array],
    saved: tuple[Array, ...],
) -> None:
    """Run all ticks.

    Args:
        inputs: the commands' part of the gates ``(time, batch, 3 units)``, including biases; measured values ``(time,
            batch, output)``, any finite number for a free port; port flags of the same shape, 1 if a port reads the
            measured value, 0 if it reads the last output; and outputs of the static map of the same shape, empty
            without a map.
        weights: weights of the feedback ``(output, 3 units)`` and of h ``(units, 3 units)``, bias of n's inner sum
            ``(units,)``, weights ``(units, output)`` and bias ``(output,)`` of the outputs, and pull p ``(output,)``,
            zero for strokes; p is empty without a map.
        bounds: scale of changes, low, high ``(output,)``, and the trapezoid ``(stroke,)``.
        velocities: number of velocities, the first outputs.
        start: last output ``(batch, output)`` and h ``(batch, units)``.
        saved: results: outputs, fed-back values and mask of inactive bounds, each ``(time, batch, output)``; gates
            ``(time, batch, 3 units)``; inner sums ``(time, batch, units)``; h ``(time + 1, batch, units)``.
    """
    projected, measured, port, mapped = inputs
    feedback_weight, h_weight, inner_bias, out_weight, out_bias, pull = weights
    scale = bounds[0]
    answers, fed, free, gates, inner, hs = saved
    ticks, batch, width = measured.shape
    into, up = np.empty_like(gates[0]), np.empty_like(gates[0])
    change = np.empty_like(start[0])
    hs[0] = start[1]
    for t in range(ticks):
        for row in range(batch):
            for j in range(width):
                last = answers[t - 1, row, j] if t > 0 else start[0][row, j]
                fed[t, row, j] = measured[t, row, j] if port[t, row, j] > 0 else last
        np.dot(fed[t], feedback_weight, into)
        np.dot(hs[t], h_weight, up)
        for row in range(batch):
            for i in range(into.shape[1]):
                into[row, i] += projected[t, row, i]
        gates_of(into, up, inner_bias, hs[t], gates[t], inner[t], hs[t + 1])
        np.dot(hs[t + 1], out_weight, change)
        for row in range(batch):
            for j in range(width):
                change[row, j] = scale[j] * (change[row, j] + out_bias[j])
            for j in range(len(pull)):
                change[row, j] += pull[j] * (mapped[t, row, j] - fed[t, row, j])
        _answer(fed[t], change, bounds, velocities, answers[t], free[t])


class BranchResults(NamedTuple):
    """Results of branches of one run.

    Attributes:
        outputs: SI units, shape (batch, sample, output); before a run branches off, the outputs of the first run.
        last_state: h of the first run after the last sample, shape (unit,).
    """

    outputs: Array
    last_state: Array


@compiler.compiled
def run_branches(
    inputs: tuple[Array, Array],
    weights: tuple[Array, ...],
    bounds: tuple[Array, ...],
    velocities: int,
    start: tuple[Array, Array],
    first: NDArray[np.int64],
    results: BranchResults,
) -> None:
    """Simulate branches of one run in free run; the common part before each branch is computed once.

    Args:
        inputs: commands in SI units ``(time, run, command)``, and outputs of the static map ``(time, run, output)``,
            empty without a map.
        weights: weights of commands in SI units and feedback ``(command + output, 3 units)``, and bias of the gates
            ``(3 units,)``; then weights of h, bias of n's inner sum, scaled weights and bias of the outputs, and p, as
            in `run_forward`; then offset and width of the outputs ``(output,)``.
        bounds: bounds of the outputs.
        velocities: number of velocities.
        start: port readings at the first sample ``(output,)``, and h ``(units,)``, equal for all runs.
        first: sample at which each run branches off run 0 ``(run,)``, ascending; 0 for run 0.
        results: buffers for the results.
    """
    answers = results.outputs
    commands, mapped = inputs
    input_weight, bias, h_weight, inner_bias, out_weight, out_bias, pull, offset, width = weights
    ticks, lanes, commanded = commands.shape
    units, count = out_weight.shape
    read = np.empty((lanes, commanded + count), np.float32)
    fed = np.empty((lanes, count), np.float32)
    free, change, answer = np.empty_like(fed), np.empty_like(fed), np.empty_like(fed)
    into = np.empty((lanes, 3 * units), np.float32)
    up, gates = np.empty_like(into), np.empty_like(into)
    h = np.empty((lanes, units), np.float32)
    next_h, inner = np.empty_like(h), np.empty_like(h)
    fed[0], h[0] = start[0], start[1]
    running = 1
    for t in range(ticks):
        while running < lanes and first[running] <= t:
            fed[running], h[running] = fed[0], h[0]
            running += 1
        for row in range(running):
            for j in range(commanded):
                read[row, j] = commands[t, row, j]
            for j in range(count):
                read[row, commanded + j] = fed[row, j]
        # The first rows: contiguous, as the products want them.
        np.dot(read[:running], input_weight, into[:running])
        np.dot(h[:running], h_weight, up[:running])
        for row in range(running):
            for i in range(3 * units):
                into[row, i] += bias[i]
        gates_of(into, up, inner_bias, h[:running], gates, inner, next_h)
        np.dot(next_h[:running], out_weight, change[:running])
        for row in range(running):
            for j in range(count):
                change[row, j] += out_bias[j]
            for j in range(len(pull)):
                change[row, j] += pull[j] * (mapped[t, row, j] - fed[row, j])
        _answer(fed[:running], change, bounds, velocities, answer, free)
        for row in range(running):
            for j in range(count):
                fed[row, j] = answer[row, j]
                answers[row, t, j] = answer[row, j] * width[j] + offset[j]
            for i in range(units):
                h[row, i] = next_h[row, i]
        for row in range(running, lanes):
            for j in range(count):
                answers[row, t, j] = answers[0, t, j]
    results.last_state[:] = h[0]


@compiler.compiled
def gates_back(
    by_h: Array, from_out: Array, gates: Array, inner: Array, h: Array, grads: tuple[Array, Array, Array]
) -> None:
    """Compute the adjoint of `gates_of`.

    Args:
        by_h: gradient by the next h ``(batch, units)``; written: by h, but for its part in the products.
        from_out: gradient by the next h that its outputs add.
        gates: gates of the forward run.
        inner: sums of n.
        h: h before the sample.
        grads: results: gradients by the pre-activations ``(batch, 3 units)``, by `inner`, and both combined for the
            products with h ``(batch, 3 units)``.
    """
    by_gates, by_inner, by_up = grads
    batch, units = by_h.shape
    for row in range(batch):
        for i in range(units):
            total = by_h[row, i] + from_out[row, i]
            reset, keep, new = gates[row, i], gates[row, units + i], gates[row, 2 * units + i]
            by_new = total * (1 - keep) * (1 - new * new)
            by_gates[row, i] = by_new * inner[row, i] * reset * (1 - reset)
            by_gates[row, units + i] = total * (h[row, i] - new) * keep * (1 - keep)
            by_gates[row, 2 * units + i] = by_new
            by_inner[row, i] = by_new * reset
            by_h[row, i] = total * keep
        for i in range(2 * units):
            by_up[row, i] = by_gates[row, i]
        for i in range(units):
            by_up[row, 2 * units + i] = by_inner[row, i]


@compiler.compiled
def run_backward(
    grad_answers: Array,
    port: Array,
    weights: tuple[Array, ...],
    bounds: tuple[Array, ...],
    velocities: int,
    saved: tuple[Array, ...],
    grads: tuple[Array, ...],
) -> None:
    """Compute the adjoint of `run_forward`, from the last sample to the first.

    Args:
        grad_answers: gradient by the outputs ``(time, batch, output)``.
        port: port flags of the forward run.
        weights: weights of the cell.
        bounds: bounds of the outputs.
        velocities: number of velocities.
        saved: results of the forward run.
        grads: results: gradients by the gates' pre-activations ``(time, batch, 3 units)``, by n's inner sum ``(time,
            batch, units)``, by o ``(time, batch, output)``, and by the start (last output and h). On entry the last two
            contain the gradients by the final output and by the final h.
    """
    feedback_weight, h_weight, _, out_weight, _, pull = weights
    scale, _, _, trapezoid = bounds
    _, _, free, gates, inner, hs = saved
    by_gates, by_inner, by_out, by_answer, by_h = grads
    ticks, batch, width = grad_answers.shape
    units, strokes = by_h.shape[1], len(trapezoid)
    # Contiguous transposes: the products of each tick read them row by row.
    feedback_up = np.ascontiguousarray(feedback_weight.T)
    h_up, out_up = np.ascontiguousarray(h_weight.T), np.ascontiguousarray(out_weight.T)
    by_fed, through = np.empty_like(by_answer), np.empty_like(by_answer)
    by_up, from_out, from_h = np.empty_like(gates[0]), np.empty_like(by_h), np.empty_like(by_h)
    for t in range(ticks - 1, -1, -1):
        for row in range(batch):
            for j in range(width):
                by_answer[row, j] += grad_answers[t, row, j]
            for j in range(width):
                by_fed[row, j] = by_answer[row, j] * free[t, row, j]
            for j in range(strokes):
                # A stroke that moves depends on the velocities of both ends of the tick.
                along = by_fed[row, velocities + j] * trapezoid[j]
                by_fed[row, j] = (by_answer[row, j] + along) * free[t, row, j]
            for j in range(width):
                by_out[t, row, j] = by_fed[row, j] * scale[j]
            for j in range(len(pull)):
                by_fed[row, j] *= 1 - pull[j]
            for j in range(strokes):
                by_out[t, row, velocities + j] = 0.0
                by_fed[row, j] += by_fed[row, velocities + j] * trapezoid[j]
        np.dot(by_out[t], out_up, from_out)
        gates_back(by_h, from_out, gates[t], inner[t], hs[t], (by_gates[t], by_inner[t], by_up))
        np.dot(by_up, h_up, from_h)
        np.dot(by_gates[t], feedback_up, through)
        for row in range(batch):
            for i in range(units):
                by_h[row, i] += from_h[row, i]
            for j in range(width):
                by_answer[row, j] = (by_fed[row, j] + through[row, j]) * (1 - port[t, row, j])
