"""Linearised rollouts: a free run of a grey box, and runs whose commands differ slightly, for predictive control.

The first run solves the equations of the grey box. In each implicit stage, every other run takes one step of Newton's
method from the solution of the first run, with the matrix of the first run and the residual of its own commands. Dead
bands and play therefore act exactly, and the error grows with the square of the distance from the first run. Volumes,
cushions, inertia and gravity use the strokes of the first run. Within the horizon of a plan, this changes the driving
forces by a few per cent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey import program as code
from edp.networks.twin.grey.correction import OutputBounds
from edp.networks.twin.grey.equations import GAMMA
from edp.networks.twin.grey.jit import compiled, inlined, inner
from edp.networks.twin.grey.program import GreyProgram
from edp.networks.twin.grey.rollouts import clamp_outputs, feed
from edp.networks.twin.grey.tick import (
    STAGE_RATIO,
    MachineArrays,
    RunValues,
    copy,
    factorise,
    fill_contents,
    freeze,
    newton,
    solve,
    work_arrays,
)
from edp.networks.twin.symbolic.machine_code import call

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
TOLERANCE = 1e-5
"""Maximum Newton step of a solved stage, MPa and m/s; the remaining error is about its square."""
BETWEEN = GAMMA / (1.0 - GAMMA)
"""Relative position of the first stage of a double step between the two stages of its first sample."""


class NearPlan(NamedTuple):
    """Commands of a first run and of runs that branch off from it.

    Attributes:
        demands: valve commands, shape (run, sample, valve).
        measured: measured values of the ports at the first sample, in units of the grey box, NaN if a port is free,
            shape (output,).
        first: sample at which each run branches off from the first run, shape (run,).
        single: number of samples with separate steps. Later steps may cover two samples; the outputs between them are
            interpolated linearly in velocity.
    """

    demands: Array
    measured: Array
    first: IntArray
    single: int


class NearRuns(NamedTuple):
    """States and buffers of all runs; index 0 is the first run.

    Attributes:
        frames: inputs of all functions, shape (run, value).
        unknowns: pressures and velocities, shape (run, unknown).
        branched: whether a run has branched off, shape (run,).
        begins: first sample with separate outputs, shape (run,).
        spools: spool positions at both stages of each step, shape (run, sample, 2 * step, valve).
        pilots: pilot positions in the middle of each step, shape (run, sample, step, valve).
        steps: Newton steps of the other runs, shape (unknown, run - 1).
        out: results of the last function.
        slopes: derivatives of the contents of the first run by its pressures, shape (node,).
        matrix: factorised matrix of the first run, shape (unknown, unknown).
    """

    frames: Array
    unknowns: Array
    branched: NDArray[np.bool_]
    begins: IntArray
    spools: Array
    pilots: Array
    steps: Array
    out: Array
    slopes: Array
    matrix: Array


@inlined
def _demand(demands: Array, history: Array, t: int, j: int, ticks: float) -> float:
    """Return the command of valve `j`, interpolated `ticks` samples before sample `t`."""
    whole = min(int(ticks), len(history) - 2)
    newer = demands[t - whole, j] if whole <= t else history[whole - t - 1, j]
    older = demands[t - whole - 1, j] if whole < t else history[whole - t, j]
    return float(newer + (ticks - whole) * (older - newer))


@inner
def simulate_valves(
    program: GreyProgram, machine: MachineArrays, runs: NearRuns, demands: Array, history: Array, first: IntArray
) -> None:
    """Compute the spool and pilot positions of all runs.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        runs: runs, whose frames contain the valve states; updated in place.
        demands: valve commands, shape (run, sample, valve).
        history: earlier valve commands, newest first, shape (sample, valve).
        first: sample at which each run branches off, shape (run,).
    """
    frame, count, ticks = program.frame, program.sizes.valves, demands.shape[1]
    length, states = machine.tick_s / machine.steps, count * at.VALVE_STATES
    before, lag_factors = np.empty((ticks, states)), np.empty((2, 2 * count))
    for stage in range(2):
        runs.frames[0, frame.length] = GAMMA * length if stage == 0 else length - GAMMA * length
        call(program.addresses[code.LAG_FACTORS], machine.parameters, machine.constants, runs.frames[0], runs.out)
        copy(lag_factors[stage], runs.out)
    for run in range(len(demands)):
        values = runs.frames[run]
        begin = first[run] if run > 0 else 0
        if begin >= ticks:
            continue
        if run > 0:
            # Copy the sample before, in case a double step starts there.
            if begin > 0:
                for stage in range(2 * machine.steps):
                    copy(runs.spools[run, begin - 1, stage], runs.spools[0, begin - 1, stage])
                for step in range(machine.steps):
                    copy(runs.pilots[run, begin - 1, step], runs.pilots[0, begin - 1, step])
            copy(values[frame.valves : frame.delayed_commands], before[begin])
        for t in range(begin, ticks):
            if run == 0:
                copy(before[t], values[frame.valves : frame.delayed_commands])
            for j in range(count):
                delay = machine.parameters[program.own[j, at.BY_DELAY]] / machine.tick_s
                delay = min(max(delay, 0.0), len(history) - 2.0)
                values[frame.delayed_commands + j] = _demand(demands[run], history, t, j, delay)
            for stage in range(2 * machine.steps):
                copy(values[frame.lag_factors : frame.mass], lag_factors[stage % 2])
                call(program.addresses[code.FAST_VALVES], machine.parameters, machine.constants, values, runs.out)
                copy(values[frame.valves : frame.delayed_commands], runs.out)
                for j in range(count):
                    state = at.VALVE_STATES * j
                    runs.spools[run, t, stage, j] = runs.out[state + at.SPOOL]
                    if stage % 2 == 0:
                        runs.pilots[run, t, stage // 2, j] = runs.out[state + at.PILOT_2]


@inner
def _begin_step(program: GreyProgram, machine: MachineArrays, runs: NearRuns, work: RunValues, length: float) -> None:
    """Initialise a step of all runs: load, contents, bristle deflections and pump displacements."""
    sizes = program.sizes
    n, pumps, nodes, frame = sizes.actuators, sizes.pumps, sizes.nodes, program.frame
    fill_contents(program, machine, work, work.frame[frame.base : frame.bristle_base], work.tangents, at.NONE)
    copy(runs.slopes, work.out[nodes : 2 * nodes])
    for run in range(len(runs.frames)):
        values = runs.frames[run]
        if not runs.branched[run]:
            continue
        if run > 0:
            copy(values[frame.frozen : frame.frozen + n], work.frame[frame.frozen : frame.frozen + n])
            copy(values[frame.mass : frame.joints], work.frame[frame.mass : frame.joints])
            copy(values[frame.speeds : frame.speeds + n], runs.unknowns[run, nodes:])
            copy(values[frame.unknowns : frame.base], runs.unknowns[run])
            _add_contents(runs, run, work.frame[frame.base : frame.bristle_base], values[frame.base :], 0.0)
        copy(values[frame.bristle_base : frame.bristle_base + n], values[frame.bristles : frame.bristles + n])
        values[frame.length] = length
        call(program.addresses[code.PUMPS], machine.parameters, machine.constants, values, runs.out)
        copy(values[frame.displacements : frame.displacements + pumps], runs.out)
        values[frame.step] = GAMMA * length


@inlined
def _add_contents(runs: NearRuns, run: int, first: Array, contents: Array, keep: float) -> None:
    """Blend contents with the linearised contents of the first run: ``keep * contents + (1 - keep) * linearised``."""
    size, nodes = runs.unknowns.shape[1], len(runs.slopes)
    for k in range(size):
        apart = runs.unknowns[run, k] - runs.unknowns[0, k]
        reached = first[k] + (runs.slopes[k] * apart if k < nodes else apart)
        contents[k] = keep * contents[k] + (1.0 - keep) * reached


@inner
def _stage(program: GreyProgram, machine: MachineArrays, runs: NearRuns, work: RunValues) -> None:
    """Solve a stage of the first run; take one step of Newton's method in every other run."""
    size, steps = len(runs.matrix), runs.steps
    values = runs.frames[0]
    newton(program, machine, work, TOLERANCE)
    y = values[:size]
    copy(runs.unknowns[0], y)
    any_branched = False
    for run in range(1, len(runs.frames)):
        if not runs.branched[run]:
            continue
        any_branched, other = True, runs.frames[run]
        copy(other[:size], y)
        call(program.addresses[code.RESIDUAL], machine.parameters, machine.constants, other, runs.out)
        for k in range(size):
            steps[k, run - 1] = runs.out[k]
    if any_branched:
        call(program.addresses[code.MATRIX], machine.parameters, machine.constants, values, runs.out)
        for row in range(size):
            copy(runs.matrix[row], runs.out[row * size : (row + 1) * size])
        factorise(runs.matrix)
        solve(runs.matrix, steps)
    for run in range(1, len(runs.frames)):
        if runs.branched[run]:
            for k in range(size):
                runs.unknowns[run, k] = y[k] - steps[k, run - 1]


@inner
def _end_stage(program: GreyProgram, machine: MachineArrays, runs: NearRuns, work: RunValues, first: bool) -> None:
    """Update the bristle deflections; after the first stage, also the bases of the second stage."""
    sizes = program.sizes
    n, nodes, frame, own = sizes.actuators, sizes.nodes, program.frame, work.frame
    call(program.addresses[code.BRISTLES], machine.parameters, machine.constants, own, runs.out)
    for run in range(1, len(runs.frames)):
        if not runs.branched[run]:
            continue
        values = runs.frames[run]
        for i in range(n):
            speed = runs.unknowns[run, nodes + i] - runs.unknowns[0, nodes + i]
            before = values[frame.bristle_base + i] - own[frame.bristle_base + i]
            values[frame.bristles + i] = runs.out[i] + runs.out[n + i] * speed + runs.out[2 * n + i] * before
    copy(own[frame.bristles : frame.bristles + n], runs.out)
    if not first:
        return
    fill_contents(program, machine, work, work.contents, work.tangents, at.NONE)
    copy(runs.slopes, work.out[nodes : 2 * nodes])
    for run in range(len(runs.frames)):
        if not runs.branched[run]:
            continue
        values = runs.frames[run]
        _add_contents(runs, run, work.contents, values[frame.base :], 1.0 - STAGE_RATIO)
        for i in range(n):
            before = values[frame.bristle_base + i]
            values[frame.bristle_base + i] = before + STAGE_RATIO * (values[frame.bristles + i] - before)


@inner
def step_all(
    program: GreyProgram, machine: MachineArrays, runs: NearRuns, work: RunValues, length: float, at_stages: Array
) -> None:
    """Advance all runs by one implicit step.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        runs: runs, whose frames contain the pilot positions; updated in place.
        work: buffers of the first run.
        length: length of the step, s.
        at_stages: spool positions at both stages, shape (run, stage, valve).
    """
    n, frame = program.sizes.actuators, program.frame
    _begin_step(program, machine, runs, work, length)
    for which in range(2):
        half = 0.5 * (GAMMA * length if which == 0 else length)
        for run in range(len(runs.frames)):
            values = runs.frames[run]
            if not runs.branched[run]:
                continue
            values[frame.half] = half
            for j in range(at_stages.shape[2]):
                values[frame.valves + at.VALVE_STATES * j + at.SPOOL] = at_stages[run, which, j]
            for i in range(n):
                values[frame.reached + i] = values[frame.strokes + i] + half * values[frame.speeds + i]
        _stage(program, machine, runs, work)
        _end_stage(program, machine, runs, work, which == 0)
    for run in range(len(runs.frames)):
        if runs.branched[run]:
            values = runs.frames[run]
            strokes, speeds = values[frame.strokes : frame.bristles], values[frame.speeds : frame.reached]
            _move_strokes(program, machine, runs, run, 0.5 * length, strokes, speeds)


@inlined
def _move_strokes(
    program: GreyProgram, machine: MachineArrays, runs: NearRuns, run: int, half: float, strokes: Array, speeds: Array
) -> None:
    """Integrate the strokes of a run by the trapezoidal rule from earlier strokes and velocities."""
    n, nodes = program.sizes.actuators, program.sizes.nodes
    for i in range(n):
        weight = half if machine.scale[i] > 0.0 else 0.0
        moved = weight * (speeds[i] + runs.unknowns[run, nodes + i])
        runs.frames[run, program.frame.strokes + i] = strokes[i] + moved


@inner
def _write(t: int, ports: IntArray, units: Array, runs: NearRuns, strokes: int, nodes: int, answers: Array) -> None:
    """Write the outputs of all branched runs after sample t, in SI units."""
    for run in range(len(answers)):
        if not runs.branched[run]:
            continue
        for c in range(len(ports)):
            kind, which = ports[c, 0], ports[c, 1]
            if kind == 1:
                value = runs.frames[run, strokes + which]
            else:
                value = runs.unknowns[run, which + (nodes if kind == 0 else 0)]
            answers[run, t, c] = value * units[c]


@inner
def _write_between(t: int, ports: IntArray, half: float, runs: NearRuns, answers: Array) -> None:
    """Interpolate the outputs of all branched runs at sample t between the samples t - 1 and t + 1.

    Args:
        t: index of the sample, at least 1.
        ports: kind and index of the state behind each output, shape (output, 2).
        half: half of the sample time, s.
        runs: simulated runs.
        answers: outputs, shape (run, sample, output); updated in place.
    """
    for run in range(len(answers)):
        if not runs.branched[run]:
            continue
        earlier = run if runs.begins[run] < t else 0
        for c in range(len(ports)):
            answers[run, t, c] = 0.5 * (answers[earlier, t - 1, c] + answers[run, t + 1, c])
    for c in range(len(ports)):
        for v in range(len(ports)):
            if ports[c, 0] != 1 or ports[v, 0] != 0 or ports[v, 1] != ports[c, 1]:
                continue
            for run in range(len(answers)):
                if runs.branched[run]:
                    earlier = run if runs.begins[run] < t else 0
                    moved = half * (answers[earlier, t - 1, v] + answers[run, t, v])
                    answers[run, t, c] = answers[earlier, t - 1, c] + moved


@inner
def _clamp_others(ports: IntArray, bounds: OutputBounds, runs: NearRuns, strokes: int, nodes: int) -> None:
    """Set states of the other runs to the bound at which the first run is."""
    for c in range(len(ports)):
        kind, which = ports[c, 0], ports[c, 1]
        index = which + (0 if kind == 2 else nodes)
        value = runs.frames[0, strokes + which] if kind == 1 else runs.unknowns[0, index]
        if bounds.low[c] < value < bounds.high[c]:
            continue
        for run in range(1, len(runs.frames)):
            runs.unknowns[run, index] = runs.unknowns[0, index]
            if kind == 1:
                runs.frames[run, strokes + which] = runs.frames[0, strokes + which]


@inner
def _make_near_runs(program: GreyProgram, count: int, ticks: int, steps: int) -> NearRuns:
    valves, size = program.sizes.valves, program.sizes.nodes + program.sizes.actuators
    return NearRuns(
        np.zeros((count, program.frame.size)),
        np.zeros((count, size)),
        np.zeros(count, np.bool_),
        np.zeros(count, np.int64),
        np.empty((count, ticks, 2 * steps, valves)),
        np.empty((count, ticks, steps, valves)),
        np.zeros((size, count - 1)),
        np.zeros(program.results),
        np.zeros(program.sizes.nodes),
        np.zeros((size, size)),
    )


@compiled
def run_near(
    program: GreyProgram,
    machine: MachineArrays,
    bounds: OutputBounds,
    plan: NearPlan,
    state: tuple[Array, ...],
    resistance: Array,
    answers: Array,
) -> None:
    """Simulate a free run and linearised neighbouring runs from the measured state.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        bounds: bounds of the outputs.
        plan: commands of all runs.
        state: unknowns, strokes, bristles, displacements, valves and history; updated to the end of the first run.
        resistance: external forces against the actuators, MN, shape (actuator,).
        answers: buffer for the outputs, SI units, shape (run, sample, output).
    """
    demands, first = plan.demands, plan.first
    y, s, z, d, valves, history = state
    sizes = program.sizes
    n, count, pumps, nodes = sizes.actuators, sizes.valves, sizes.pumps, sizes.nodes
    frame, ports = program.frame, machine.ports
    runs, ticks = _make_near_runs(program, len(demands), demands.shape[1], machine.steps), demands.shape[1]
    work = work_arrays(program, 0)
    shared = RunValues(
        runs.frames[0], work.tangents, work.own, work.out, work.contents, work.rows, work.states, work.before,
        work.rows_before,
    )  # fmt: skip
    for j in range(count):
        first_state = frame.valves + at.VALVE_STATES * j
        copy(runs.frames[0, first_state : first_state + at.VALVE_STATES], valves[j])
    simulate_valves(program, machine, runs, demands, history, first)
    for j in range(count):
        copy(valves[j], runs.frames[0, frame.valves + at.VALVE_STATES * j : frame.delayed_commands])
    feed(ports, plan.measured, y, s)
    own = runs.frames[0]
    copy(runs.unknowns[0], y)
    copy(own[frame.strokes : frame.strokes + n], s)
    copy(own[frame.bristles : frame.bristles + n], z)
    copy(own[frame.displacements : frame.displacements + pumps], d)
    runs.branched[0] = True
    before, at_stages, t = np.empty((len(demands), 2 * n)), np.empty((len(demands), 2, count)), 0
    while t < ticks:
        double = t >= plan.single and t + 1 < ticks
        _branch(program, runs, first, t, t + (2 if double else 1))
        for run in range(len(demands)):
            if not runs.branched[run]:
                continue
            copy(before[run, :n], runs.frames[run, frame.strokes : frame.strokes + n])
            copy(before[run, n:], runs.unknowns[run, nodes:])
        for step in range(1 if double else machine.steps):
            for run in range(len(demands)):
                if runs.branched[run]:
                    _set_stage_valves(program, runs, run, t, step, double, at_stages[run])
            length = 2.0 * machine.tick_s if double else machine.tick_s / machine.steps
            copy(own[:nodes], runs.unknowns[0])
            copy(own[nodes : nodes + n], runs.unknowns[0, nodes:])
            freeze(program, machine, shared, length, at.NONE)
            for i in range(n):
                own[frame.forces + i] += resistance[i]
            step_all(program, machine, runs, shared, length, at_stages)
        whole = 2.0 * machine.tick_s if double else machine.tick_s
        # A twin guarantees that strokes are the trapezoidal integral of its velocity outputs.
        for run in range(len(demands)):
            if runs.branched[run]:
                _move_strokes(program, machine, runs, run, 0.5 * whole, before[run, :n], before[run, n:])
        strokes = own[frame.strokes : frame.strokes + n]
        clamp_outputs(ports, bounds, before[0], runs.unknowns[0], strokes, whole)
        _clamp_others(ports, bounds, runs, frame.strokes, nodes)
        t += 2 if double else 1
        _write(t - 1, ports, bounds.units, runs, frame.strokes, nodes, answers)
        if double:
            _write_between(t - 2, ports, 0.25 * whole, runs, answers)
    for run in range(1, len(demands)):
        for earlier in range(runs.begins[run] if runs.branched[run] else ticks):
            copy(answers[run, earlier], answers[0, earlier])
    copy(y, runs.unknowns[0])
    copy(s, own[frame.strokes : frame.strokes + n])
    copy(z, own[frame.bristles : frame.bristles + n])
    copy(d, own[frame.displacements : frame.displacements + pumps])
    for k in range(len(history) - 1, -1, -1):
        copy(history[k], demands[0, ticks - 1 - k] if k < ticks else history[k - ticks])


@inner
def _branch(program: GreyProgram, runs: NearRuns, first: IntArray, t: int, end: int) -> None:
    """Start all runs that branch off before sample `end`, at sample `t` from the state of the first run."""
    frame = program.frame
    for run in range(1, len(first)):
        if runs.branched[run] or first[run] >= end:
            continue
        runs.branched[run], runs.begins[run] = True, t
        copy(runs.unknowns[run], runs.unknowns[0])
        copy(
            runs.frames[run, frame.displacements : frame.tangents], runs.frames[0, frame.displacements : frame.tangents]
        )


@inlined
def _set_stage_valves(
    program: GreyProgram, runs: NearRuns, run: int, t: int, step: int, double: bool, at_stages: Array
) -> None:
    """Set the pilot positions of a step and the spool positions of its stages."""
    spools, pilots = runs.spools[run, t], runs.pilots[run, t]
    for j in range(spools.shape[1]):
        pilot = program.frame.valves + at.VALVE_STATES * j + at.PILOT_2
        if double:
            after, later = runs.spools[run, t + 1], runs.pilots[run, t + 1]
            at_stages[0, j] = (1.0 - BETWEEN) * spools[0, j] + BETWEEN * spools[1, j]
            at_stages[1, j] = after[1, j]
            runs.frames[run, pilot] = (1.0 - GAMMA) * pilots[0, j] + GAMMA * later[0, j]
        else:
            at_stages[0, j], at_stages[1, j] = spools[2 * step, j], spools[2 * step + 1, j]
            runs.frames[run, pilot] = pilots[step, j]
