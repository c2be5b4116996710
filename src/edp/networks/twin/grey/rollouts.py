"""Batched simulation of grey boxes, and the errors of a fit with their derivatives."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.correction import (
    Cell,
    OutputBounds,
    RunTrace,
    correct,
    note_bounds,
    note_slopes,
    read_ports,
    seed,
    state_rows,
)
from edp.networks.twin.grey.equations import GAMMA
from edp.networks.twin.grey.jit import compiled, inlined, inner
from edp.networks.twin.grey.program import GreyProgram
from edp.networks.twin.grey.tick import (
    MachineArrays,
    RunValues,
    advance_valves,
    clear_rows,
    copy,
    copy_rows,
    move_bristles,
    move_pumps,
    tick,
    work_arrays,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


class RunBatch(NamedTuple):
    """Batch of runs in units of the grey box. A simulation updates `answers` and all following arrays in place.

    Attributes:
        demands: valve commands, shape (run, sample, valve).
        measured: measured values of the ports, NaN if a port is free, shape (run, sample, output).
        answers: last outputs, shape (run, output).
        unknowns: pressures and velocities, shape (run, unknown).
        strokes: strokes, shape (run, actuator).
        bristles: bristle deflections, shape (run, actuator).
        displacements: pump displacements, shape (run, pump).
        valves: valve states, shape (run, valve, state).
        history: earlier valve commands, newest first, shape (run, sample, valve).
    """

    demands: Array
    measured: Array
    answers: Array
    unknowns: Array
    strokes: Array
    bristles: Array
    displacements: Array
    valves: Array
    history: Array


class FitTarget(NamedTuple):
    """Measured outputs of a fit, and buffers for the errors of one run.

    Attributes:
        truth: measured outputs, shape (run, sample, output).
        weight: weight of the errors, shape (output,).
        delta: weighted error at which the Huber loss becomes linear.
        prefix: number of samples at the start that are not evaluated.
        followed: number of samples at the start in which the load is fully measured and not simulated.
        stride: number of samples from one evaluated sample to the next.
        errors: buffer for weighted errors, shape (row,); empty if only the loss is required.
        slopes: buffer for the derivatives of the errors by the parameters, shape (row, parameter).
    """

    truth: Array
    weight: Array
    delta: float
    prefix: int
    followed: int
    stride: int
    errors: Array
    slopes: Array


@inner
def _set_port(kind: int, which: int, value: float, y: Array, s: Array, nodes: int) -> None:
    """Replace the state of a port: velocity (kind 0), stroke (kind 1) or pressure (kind 2)."""
    if kind == 1:
        s[which] = value
    elif kind == 0:
        y[nodes + which] = value
    else:
        y[which] = max(value, at.LEAST_ABSOLUTE - at.ATMOSPHERE)


@inner
def feed(ports: IntArray, measured: Array, y: Array, s: Array) -> None:
    """Replace the states of all measured ports."""
    nodes = len(y) - len(s)
    for c in range(len(ports)):
        if np.isfinite(measured[c]):
            _set_port(ports[c, 0], ports[c, 1], measured[c], y, s, nodes)


@inner
def feed_back(ports: IntArray, measured: Array, answers: Array, y: Array, s: Array) -> None:
    """Replace the states of measured ports by the measurement, and of free ports by the rounded last output."""
    nodes = len(y) - len(s)
    for c in range(len(ports)):
        value = measured[c] if np.isfinite(measured[c]) else answers[c]
        _set_port(ports[c, 0], ports[c, 1], value, y, s, nodes)


@inner
def clear_tangents(ports: IntArray, measured: Array, t_y: Array, t_s: Array) -> None:
    """Set the tangents of measured ports to zero."""
    nodes = len(t_y) - len(t_s)
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        if not np.isfinite(measured[c]):
            continue
        row = t_s[which] if kind == 1 else t_y[which + (nodes if kind == 0 else 0)]
        for k in range(len(row)):
            row[k] = 0.0


@inner
def clamp_outputs(ports: IntArray, bounds: OutputBounds, before: Array, y: Array, s: Array, time: float) -> None:
    """Limit velocities and pressures, then strokes, to their bounds; set velocities into an end stop to zero.

    Args:
        ports: kind and index of the state behind each output.
        bounds: bounds of the outputs.
        before: strokes and velocities `time` seconds earlier.
        y: unknowns; updated in place.
        s: strokes; updated in place.
        time: time step, s.
    """
    n, nodes = len(s), len(y) - len(s)
    for turn in range(2):
        for c in range(len(ports)):
            kind, which = ports[c, 0], ports[c, 1]
            if (kind == 1) != (turn == 1):
                continue
            low, high = bounds.low[c], bounds.high[c]
            if kind == 1:
                value = before[which] + 0.5 * time * (before[n + which] + y[nodes + which])
                s[which] = min(max(value, low), high)
                speed = y[nodes + which]
                y[nodes + which] = min(speed, 0.0) if value > high else (max(speed, 0.0) if value < low else speed)
            else:
                index = which + (nodes if kind == 0 else 0)
                y[index] = min(max(y[index], low), high)


@inner
def _begin(program: GreyProgram, work: RunValues, batch: RunBatch, run: int) -> None:
    """Load the state of a run and set all tangents to zero."""
    sizes = program.sizes
    n, pumps, nodes, frame = sizes.actuators, sizes.pumps, sizes.nodes, program.frame
    copy(work.frame[: nodes + n], batch.unknowns[run])
    copy(work.frame[frame.strokes : frame.strokes + n], batch.strokes[run])
    copy(work.frame[frame.bristles : frame.bristles + n], batch.bristles[run])
    copy(work.frame[frame.displacements : frame.displacements + pumps], batch.displacements[run])
    for j in range(batch.valves.shape[1]):
        for k in range(at.VALVE_STATES):
            work.frame[frame.valves + at.VALVE_STATES * j + k] = batch.valves[run, j, k]
    clear_rows(work.tangents)
    clear_rows(work.own)


@inner
def _end(program: GreyProgram, work: RunValues, batch: RunBatch, run: int) -> None:
    """Store the state of a run."""
    sizes = program.sizes
    n, pumps, nodes, frame = sizes.actuators, sizes.pumps, sizes.nodes, program.frame
    copy(batch.unknowns[run], work.frame[: nodes + n])
    copy(batch.strokes[run], work.frame[frame.strokes : frame.strokes + n])
    copy(batch.bristles[run], work.frame[frame.bristles : frame.bristles + n])
    copy(batch.displacements[run], work.frame[frame.displacements : frame.displacements + pumps])
    for j in range(batch.valves.shape[1]):
        for k in range(at.VALVE_STATES):
            batch.valves[run, j, k] = work.frame[frame.valves + at.VALVE_STATES * j + k]


@inner
def _push_commands(history: Array, demands: Array) -> None:
    """Insert the commands of a sample at the start of the history."""
    for k in range(len(history) - 1, 0, -1):
        copy(history[k], history[k - 1])
    copy(history[0], demands)


@inner
def _follow(program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, tangents_by: int) -> None:
    """Advance valves, pumps and bristles by one sample while the load is fully measured."""
    n, frame, by_parameters = program.sizes.actuators, program.frame, tangents_by == at.BY_PARAMETERS
    advance_valves(program, machine, work, history, GAMMA * machine.tick_s, by_parameters)
    move_pumps(program, machine, work, machine.tick_s, tangents_by)
    advance_valves(program, machine, work, history, (1.0 - GAMMA) * machine.tick_s, by_parameters)
    work.frame[frame.step] = machine.tick_s
    copy(work.frame[frame.bristle_base : frame.bristle_base + n], work.frame[frame.bristles : frame.bristles + n])
    if tangents_by:
        copy_rows(
            work.tangents[frame.bristle_base : frame.bristle_base + n],
            work.tangents[frame.bristles : frame.bristles + n],
        )
    move_bristles(program, machine, work, tangents_by)


@compiled
def evaluate_run(program: GreyProgram, machine: MachineArrays, batch: RunBatch, run: int, target: FitTarget) -> float:
    """Simulate one run of a batch, write its errors and return its Huber loss.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        batch: batch of runs; updated in place.
        run: index of the run.
        target: measured outputs and buffers.
    """
    sizes, ports, history = program.sizes, machine.ports, batch.history[run]
    n, nodes = sizes.actuators, sizes.nodes
    full = len(target.errors) > 0
    tangents_by = at.BY_PARAMETERS if full else at.NONE
    work = work_arrays(program, sizes.parameters if full else 0)
    first = program.frame.strokes
    y, s = work.frame[: nodes + n], work.frame[first : first + n]
    t_y, t_s = work.tangents[: nodes + n], work.tangents[first : first + n]
    _begin(program, work, batch, run)
    loss, used, ticks = 0.0, 0, batch.demands.shape[1]
    for t in range(ticks):
        feed(ports, batch.measured[run, t], y, s)
        if full:
            clear_tangents(ports, batch.measured[run, t], t_y, t_s)
        _push_commands(history, batch.demands[run, t])
        if t < target.followed:
            _follow(program, machine, work, history, tangents_by)
            continue
        tick(program, machine, work, history, tangents_by)
        done = t + 1 - target.prefix
        if done > 0 and (done % target.stride == 0 or t + 1 == ticks):
            loss += _sum_errors(program, machine, target, target.truth[run, t], work, used)
            used += len(ports) if full else 0
    _end(program, work, batch, run)
    return loss


@inner
def _sum_errors(
    program: GreyProgram, machine: MachineArrays, target: FitTarget, truth: Array, work: RunValues, used: int
) -> float:
    """Return the Huber loss of one sample, and write errors and derivatives, starting at row `used`."""
    loss, nodes = 0.0, program.sizes.nodes
    for c in range(len(machine.ports)):
        kind = machine.ports[c, 0]
        first = nodes if kind == 0 else (program.frame.strokes if kind == 1 else 0)
        row = first + machine.ports[c, 1]
        error = target.weight[c] * (work.frame[row] - truth[c])
        size = abs(error)
        loss += 0.5 * error * error if size <= target.delta else target.delta * (size - 0.5 * target.delta)
        if len(target.errors) > 0:
            # Weight errors above delta by their gradient (iteratively reweighted least squares).
            share = 1.0 if size <= target.delta else math.sqrt(target.delta / size)
            target.errors[used + c] = share * error
            for k in range(work.tangents.shape[1]):
                target.slopes[used + c, k] = share * target.weight[c] * work.tangents[row, k]
    return loss


@compiled
def run_batch(
    program: GreyProgram,
    machine: MachineArrays,
    bounds: OutputBounds,
    batch: RunBatch,
    answers: Array,
    cell: Cell | None,
    trace: RunTrace | None,
) -> None:
    """Simulate a batch of runs and write bounded outputs, rounded to single precision.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        bounds: bounds of the outputs.
        batch: batch of runs; updated in place.
        answers: buffer for the outputs, SI units, shape (run, sample, output).
        cell: network that corrects the outputs; None for a grey box alone.
        trace: buffers for `edp.networks.twin.grey.correction.run_back`; None if no gradient is required.
    """
    sizes = program.sizes
    n, nodes, frame, ports = sizes.actuators, sizes.nodes, program.frame, machine.ports
    columns = 0
    if trace is not None:
        columns = trace.slopes.shape[2]
    work = work_arrays(program, columns)
    values, tangents = work.frame, work.tangents
    y, s = values[: nodes + n], values[frame.strokes : frame.strokes + n]
    before, fed, proposed = np.zeros(2 * n), np.zeros(len(ports)), np.zeros(len(ports))
    rows = state_rows(program)
    for run in range(len(batch.demands)):
        history, by_weights = batch.history[run], False
        _begin(program, work, batch, run)
        for t in range(batch.demands.shape[1]):
            measured = batch.measured[run, t]
            feed_back(ports, measured, batch.answers[run], y, s)
            _push_commands(history, batch.demands[run, t])
            copy(before[:n], s)
            copy(before[n:], y[nodes:])
            tangents_by = at.NONE
            if cell is not None:
                read_ports(ports, y, s, fed)
            if trace is not None:
                by_weights = by_weights or not _are_finite(measured)
                tangents_by = at.BY_STATE if by_weights else at.NONE
                seed(rows, tangents)
            tick(program, machine, work, history, tangents_by)
            if trace is not None and by_weights:
                note_slopes((t, run), rows, tangents, trace)
            if cell is not None:
                correct((t, run), y, s, fed, ports, cell, trace)
                read_ports(ports, y, s, proposed)
            clamp_outputs(ports, bounds, before, y, s, machine.tick_s)
            if trace is not None:
                note_bounds((t, run), y, s, ports, bounds, proposed, trace)
            # Round the state to single precision, so that one call and many short calls give the same bits.
            _round(values[: frame.delayed_commands])
            for row in history:
                _round(row)
            _write_answers(ports, bounds, y, s, answers[run, t], batch.answers[run])
        _end(program, work, batch, run)


@inlined
def _are_finite(values: Array) -> bool:
    finite = True
    for value in values:
        finite = finite and np.isfinite(value)
    return finite


@inlined
def _round(values: Array) -> None:
    for k in range(len(values)):
        values[k] = np.float32(values[k])


@inner
def _write_answers(ports: IntArray, bounds: OutputBounds, y: Array, s: Array, answers: Array, last: Array) -> None:
    """Write the outputs in SI units and in units of the grey box, rounded to single precision."""
    nodes = len(y) - len(s)
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        value = s[which] if kind == 1 else y[which + (nodes if kind == 0 else 0)]
        answer = np.float32(value * bounds.units[c])
        answers[c] = answer
        last[c] = answer / bounds.units[c]
