"""Time stepping of a grey box: one sample of one run, optionally with its exact derivatives (tangents)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey import program as code
from edp.networks.twin.grey.equations import GAMMA
from edp.networks.twin.grey.jit import inlined, inner
from edp.networks.twin.grey.linkage import joint_angle
from edp.networks.twin.grey.program import ANGLES, GreyProgram
from edp.networks.twin.symbolic.machine_code import call

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
STAGE_RATIO = (1.0 - GAMMA) / GAMMA
"""Extrapolation factor from the first stage to the base of the second stage."""
ITERATIONS = 30
TOLERANCE = 1e-9
"""Maximum Newton step of a solved stage, MPa and m/s; far below the rounding of single precision."""
LARGEST = 4.0
"""Maximum pressure change in a Newton step, MPa. The derivative of a square root is valid only in a small range."""


class MachineArrays(NamedTuple):
    """Parameters and constants of one machine.

    Attributes:
        parameters: parameters, shape (parameter,).
        constants: see `edp.networks.twin.grey.equations.GreyForm.constants`.
        scale: scale of each stroke, 0 if the stroke is not measured, shape (actuator,).
        linkage: see `edp.networks.twin.grey.parameter_index`; empty if the load is a polynomial of the strokes.
        ports: kind and index of the state behind each output, shape (output, 2).
        tick_s: sample time, s.
        steps: number of implicit steps per sample.
    """

    parameters: Array
    constants: Array
    scale: Array
    linkage: Array
    ports: IntArray
    tick_s: float
    steps: int


def machine_arrays(
    parameters: Array, strokes: tuple[Array, Array], linkage: Array, ports: IntArray, time: tuple[float, int]
) -> MachineArrays:
    """Return the arrays of a machine.

    Args:
        parameters: parameters, shape (parameter,).
        strokes: middle and scale of the strokes, shape (actuator,) each.
        linkage: see `MachineArrays`.
        ports: see `MachineArrays`.
        time: sample time (s), and number of implicit steps per sample.
    """
    bodies = linkage[: at.JOINTS] if len(linkage) else np.zeros(at.JOINTS)
    return MachineArrays(parameters, np.concatenate([*strokes, bodies]), strokes[1], linkage, ports, *time)


class RunValues(NamedTuple):
    """Inputs, tangents and buffers of one run.

    Attributes:
        frame: inputs of all functions, see `edp.networks.twin.grey.program.FramePlaces`.
        tangents: derivatives of the first values of `frame`, shape (value, column).
        own: derivatives of the valve states by the parameters of the valve, shape (valve * state, OWN).
        out: results of the last function.
        contents: buffer for contents and velocities, shape (unknown,).
        rows: buffer for derivatives of unknowns, shape (unknown, column).
        states: buffer for derivatives of valve states, shape (valve * state, OWN).
        before: strokes and velocities at the start of the sample, shape (2 * actuator,).
        rows_before: derivatives of `before`, shape (2 * actuator, column).
    """

    frame: Array
    tangents: Array
    own: Array
    out: Array
    contents: Array
    rows: Array
    states: Array
    before: Array
    rows_before: Array


@inner
def work_arrays(program: GreyProgram, columns: int) -> RunValues:
    """Return empty buffers for a run with this number of tangent columns."""
    sizes = program.sizes
    n, valves, nodes = sizes.actuators, sizes.valves, sizes.nodes
    unknowns, rows = nodes + n, program.frame.tangents if columns > 0 else 0
    return RunValues(
        np.zeros(program.frame.size),
        np.zeros((rows, columns)),
        np.zeros((valves * at.VALVE_STATES, at.OWN)),
        np.zeros(program.results),
        np.zeros(unknowns),
        np.zeros((unknowns if columns > 0 else 0, columns)),
        np.zeros((valves * at.VALVE_STATES, at.OWN)),
        np.zeros(2 * n),
        np.zeros((2 * n if columns > 0 else 0, columns)),
    )


@inlined
def copy(target: Array, source: Array) -> None:
    """Copy values by a loop, which compiles ten times faster than an assignment to a slice."""
    for k in range(len(target)):
        target[k] = source[k]


@inlined
def copy_rows(target: Array, source: Array) -> None:
    """Copy rows of tangents."""
    for row in range(target.shape[0]):
        for k in range(target.shape[1]):
            target[row, k] = source[row, k]


@inlined
def clear_rows(target: Array) -> None:
    """Set rows of tangents to zero."""
    for row in range(target.shape[0]):
        for k in range(target.shape[1]):
            target[row, k] = 0.0


@inner
def factorise(a: Array) -> None:
    """Factorise a matrix in place (LU) without pivoting; pressures come first, where the diagonal dominates."""
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
    """Replace columns by the solutions of the factorised equations, shape (unknown, column)."""
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
def newton(program: GreyProgram, machine: MachineArrays, work: RunValues, tolerance: float) -> int:
    """Solve a stage by Newton's method until the step is below `tolerance`; return the number of iterations."""
    nodes, size = program.sizes.nodes, len(work.contents)
    y, change = work.frame[:size], work.out
    share, before, at_before = 1.0, 0.0, -1
    for iteration in range(ITERATIONS):
        call(program.addresses[code.NEWTON], machine.parameters, machine.constants, work.frame, work.out)
        most = 0
        for k in range(1, size):
            if abs(change[k]) > abs(change[most]):
                most = k
        largest = change[most]
        # Halve steps that alternate in sign: where a check valve or a relief valve toggles, full steps never converge.
        to_and_fro = most == at_before and largest * before < 0.0 and abs(largest) > 0.5 * abs(before)
        share = max(0.5 * share, 0.125) if to_and_fro else min(2.0 * share, 1.0)
        before, at_before = largest, most
        for k in range(nodes):
            moved = min(max(share * change[k], -LARGEST), LARGEST)
            # Approach a vacuum by fractions of the remaining pressure: the content has a pole at zero.
            y[k] = max(y[k] - moved, 0.25 * (y[k] + at.ATMOSPHERE) - at.ATMOSPHERE)
        for k in range(nodes, size):
            y[k] -= share * change[k]
        if abs(largest) < tolerance:
            return iteration + 1
    return ITERATIONS


@inlined
def _add_rows(program: GreyProgram, group: int, work: RunValues, target: Array, sign: float) -> None:
    """Add the products of derivatives and tangents of their variables to `target`."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        slope = sign * work.out[first + e - begin]
        if slope != 0.0:
            row, column = program.entries[e]
            for k in range(target.shape[1]):
                target[row, k] += slope * work.tangents[column, k]


@inlined
def _add_parameters(program: GreyProgram, group: int, work: RunValues, target: Array, sign: float) -> None:
    """Add the derivatives by parameters to the columns of `target`."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        row, column = program.entries[e]
        target[row, column] += sign * work.out[first + e - begin]


@inlined
def _add_own(program: GreyProgram, group: int, state: int, work: RunValues, target: Array, sign: float) -> None:
    """Add the products of derivatives by a state of each valve and the tangents of this state to `target`."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        slope = sign * work.out[first + e - begin]
        row, j = program.entries[e]
        for k in range(at.OWN):
            target[row, program.own[j, k]] += slope * work.own[at.VALVE_STATES * j + state, k]


@inlined
def _delay_slope(machine: MachineArrays, program: GreyProgram, history: Array, j: int) -> float:
    """Return the derivative of a delayed command by its dead time."""
    ticks = machine.parameters[program.own[j, at.BY_DELAY]] / machine.tick_s
    if not 0.0 <= ticks <= len(history) - 2.0:
        return 0.0
    whole = min(int(ticks), len(history) - 2)
    return float((history[whole + 1, j] - history[whole, j]) / machine.tick_s)


@inner
def advance_valves(
    program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, length: float, by_parameters: bool
) -> None:
    """Advance all valves by `length` seconds, with their tangents."""
    frame, out, count = work.frame, work.out, program.sizes.valves
    for j in range(count):
        delay = machine.parameters[program.own[j, at.BY_DELAY]]
        ticks = min(max(delay / machine.tick_s, 0.0), len(history) - 2.0)
        whole = min(int(ticks), len(history) - 2)
        newer, older = history[whole, j], history[whole + 1, j]
        frame[program.frame.delayed_commands + j] = newer + (ticks - whole) * (older - newer)
    frame[program.frame.length] = length
    call(program.addresses[code.VALVES], machine.parameters, machine.constants, frame, out)
    states = count * at.VALVE_STATES
    if by_parameters:
        clear_rows(work.states)
        first_slope, begin, end = program.groups[code.VALVE_STATES]
        for e in range(begin, end):
            slope = out[first_slope + e - begin]
            row, column = program.entries[e]
            if column < states:
                for k in range(at.OWN):
                    work.states[row, k] += slope * work.own[column, k]
            else:
                work.states[row, at.BY_DELAY] += slope * _delay_slope(machine, program, history, column - states)
        _add_parameters(program, code.VALVE_OWN, work, work.states, 1.0)
        copy_rows(work.own, work.states)
    first = program.frame.valves
    copy(frame[first : first + states], out)


@inner
def move_pumps(program: GreyProgram, machine: MachineArrays, work: RunValues, length: float, tangents_by: int) -> None:
    """Advance all pump displacements by `length` seconds, with their tangents."""
    first, count = program.frame.displacements, program.sizes.pumps
    work.frame[program.frame.length] = length
    call(program.addresses[code.PUMPS], machine.parameters, machine.constants, work.frame, work.out)
    if tangents_by and count > 0:
        after = work.rows[:count]
        clear_rows(after)
        _add_rows(program, code.PUMP_FRAME, work, after, 1.0)
        if tangents_by == at.BY_PARAMETERS:
            _add_own(program, code.PUMP_PILOTS, at.PILOT_2, work, after, 1.0)
            _add_parameters(program, code.PUMP_PARAMETERS, work, after, 1.0)
        copy_rows(work.tangents[first : first + count], after)
    copy(work.frame[first : first + count], work.out)


@inner
def move_bristles(program: GreyProgram, machine: MachineArrays, work: RunValues, tangents_by: int) -> None:
    """Compute the bristle deflections at the end of a stage, with their tangents."""
    sizes = program.sizes
    n, nodes, frame = sizes.actuators, sizes.nodes, program.frame
    call(program.addresses[code.BRISTLES], machine.parameters, machine.constants, work.frame, work.out)
    for i in range(n):
        work.frame[frame.bristles + i] = work.out[i]
    if tangents_by:
        for i in range(n):
            by_speed, by_before = work.out[n + i], work.out[2 * n + i]
            for k in range(work.tangents.shape[1]):
                work.tangents[frame.bristles + i, k] = (
                    by_before * work.tangents[frame.bristle_base + i, k] + by_speed * work.tangents[nodes + i, k]
                )
    if tangents_by == at.BY_PARAMETERS:
        _add_parameters(program, code.BRISTLE_PARAMETERS, work, work.tangents[frame.bristles :], 1.0)


@inner
def fill_contents(
    program: GreyProgram, machine: MachineArrays, work: RunValues, contents: Array, tangents: Array, tangents_by: int
) -> None:
    """Write the contents of all nodes, followed by the velocities, with their tangents."""
    nodes, size = program.sizes.nodes, len(contents)
    call(program.addresses[code.CONTENTS], machine.parameters, machine.constants, work.frame, work.out)
    copy(contents[:nodes], work.out)
    copy(contents[nodes:], work.frame[nodes:size])
    if tangents_by:
        copy_rows(tangents[nodes:size], work.tangents[nodes:size])
        for k in range(nodes):
            slope = work.out[nodes + k]
            for c in range(work.tangents.shape[1]):
                tangents[k, c] = slope * work.tangents[k, c]
    if tangents_by == at.BY_PARAMETERS:
        _add_parameters(program, code.CONTENT_PARAMETERS, work, tangents, 1.0)


@inner
def stage_tangents(program: GreyProgram, machine: MachineArrays, work: RunValues, tangents_by: int) -> None:
    """Solve ``R_y y' = -(R_q + R_u u')`` for the tangents y' of the unknowns at the end of a stage."""
    size = len(work.contents)
    call(program.addresses[code.SLOPES], machine.parameters, machine.constants, work.frame, work.out)
    solved = work.tangents[:size]
    clear_rows(solved)
    _add_rows(program, code.BY_FRAME, work, solved, -1.0)
    if tangents_by == at.BY_PARAMETERS:
        _add_own(program, code.BY_SPOOL, at.SPOOL, work, solved, -1.0)
        _add_parameters(program, code.BY_PARAMETER, work, solved, -1.0)
    by_y = work.out[: size * size].reshape(size, size)
    factorise(by_y)
    solve(by_y, solved)


@inlined
def _extrapolate(base: Array, reached: Array) -> None:
    """Extrapolate tangents from the base of the first stage to the base of the second stage."""
    for row in range(len(base)):
        for k in range(base.shape[1]):
            base[row, k] += STAGE_RATIO * (reached[row, k] - base[row, k])


@inner
def freeze(program: GreyProgram, machine: MachineArrays, work: RunValues, length: float, tangents_by: int) -> None:
    """Compute the strokes in the middle of a step of `length` seconds, and the load at these strokes."""
    sizes = program.sizes
    n, nodes, frame, values = sizes.actuators, sizes.nodes, program.frame, work.frame
    for i in range(n):
        half = 0.5 * length if machine.scale[i] > 0.0 else 0.0
        values[frame.speeds + i] = values[nodes + i]
        values[frame.frozen + i] = values[frame.strokes + i] + half * values[nodes + i]
        if tangents_by:
            for k in range(work.tangents.shape[1]):
                speed = work.tangents[nodes + i, k]
                work.tangents[frame.speeds + i, k] = speed
                work.tangents[frame.frozen + i, k] = work.tangents[frame.strokes + i, k] + half * speed
    if len(machine.linkage) > 0:
        for a in range(at.BODIES):
            joint, angle = at.JOINTS + a * at.JOINT_VALUES, frame.joints + ANGLES * a
            stroke = values[frame.frozen + int(machine.linkage[joint + at.ACTUATOR])]
            values[angle], values[angle + 1], values[angle + 2], values[angle + 3] = joint_angle(
                machine.linkage, joint, stroke
            )
    call(program.addresses[code.LOAD], machine.parameters, machine.constants, values, work.out)
    copy(values[frame.mass : frame.mass + n * n + n], work.out)


class StrokeStart(NamedTuple):
    """Strokes and velocities at the start of an integration, shape (actuator,), and their tangents."""

    strokes: Array
    speeds: Array
    stroke_tangents: Array
    speed_tangents: Array


@inner
def move_strokes(
    program: GreyProgram, machine: MachineArrays, values: RunValues, half: float, start: StrokeStart
) -> None:
    """Integrate the strokes and their tangents by the trapezoidal rule over a time of 2 * `half` seconds."""
    nodes, first = program.sizes.nodes, program.frame.strokes
    for i in range(program.sizes.actuators):
        # A stroke that is not measured has no scale; no equation depends on it, and it stays constant.
        weight = half if machine.scale[i] > 0.0 else 0.0
        values.frame[first + i] = start.strokes[i] + weight * (start.speeds[i] + values.frame[nodes + i])
        for k in range(start.stroke_tangents.shape[1]):
            moved = weight * (start.speed_tangents[i, k] + values.tangents[nodes + i, k])
            values.tangents[first + i, k] = start.stroke_tangents[i, k] + moved


@inner
def step(
    program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, length: float, tangents_by: int
) -> int:
    """Advance one run by one implicit step of `length` seconds; return the number of Newton iterations."""
    sizes = program.sizes
    n, nodes, frame = sizes.actuators, sizes.nodes, program.frame
    values, tangents, size, spent = work.frame, work.tangents, nodes + program.sizes.actuators, 0
    freeze(program, machine, work, length, tangents_by)
    base, z = values[frame.base : frame.base + size], values[frame.bristles : frame.bristles + n]
    base_z = values[frame.bristle_base : frame.bristle_base + n]
    t_base = tangents[frame.base : frame.base + size]
    fill_contents(program, machine, work, base, t_base, tangents_by)
    copy(base_z, z)
    if tangents_by:
        copy_rows(tangents[frame.bristle_base : frame.bristle_base + n], tangents[frame.bristles : frame.bristles + n])
    values[frame.step] = GAMMA * length
    for which in range(2):
        moved = GAMMA * length if which == 0 else length - GAMMA * length
        advance_valves(program, machine, work, history, moved, tangents_by == at.BY_PARAMETERS)
        if which == 0:
            move_pumps(program, machine, work, length, tangents_by)
        half = 0.5 * (GAMMA * length if which == 0 else length)
        values[frame.half] = half
        for i in range(n):
            values[frame.reached + i] = values[frame.strokes + i] + half * values[frame.speeds + i]
            if tangents_by:
                for k in range(tangents.shape[1]):
                    tangents[frame.reached + i, k] = (
                        tangents[frame.strokes + i, k] + half * tangents[frame.speeds + i, k]
                    )
        spent += newton(program, machine, work, TOLERANCE)
        if tangents_by:
            stage_tangents(program, machine, work, tangents_by)
        move_bristles(program, machine, work, tangents_by)
        if which == 0:
            fill_contents(program, machine, work, work.contents, work.rows, tangents_by)
            for k in range(size):
                base[k] += STAGE_RATIO * (work.contents[k] - base[k])
            for i in range(n):
                base_z[i] += STAGE_RATIO * (z[i] - base_z[i])
            if tangents_by:
                _extrapolate(t_base, work.rows)
                _extrapolate(
                    tangents[frame.bristle_base : frame.bristle_base + n],
                    tangents[frame.bristles : frame.bristles + n],
                )
    strokes, speeds = slice(frame.strokes, frame.strokes + n), slice(frame.speeds, frame.speeds + n)
    start = StrokeStart(values[strokes], values[speeds], tangents[strokes], tangents[speeds])
    move_strokes(program, machine, work, 0.5 * length, start)
    return spent


@inner
def tick(program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, tangents_by: int) -> int:
    """Advance one run by one sample.

    Args:
        program: compiled equations.
        machine: parameters and constants.
        work: values of the run; updated in place.
        history: valve commands, newest first, shape (sample, valve).
        tangents_by: variables of the tangents: `parameter_index.NONE`, `BY_PARAMETERS` or `BY_STATE`.

    Returns:
        Number of Newton iterations.
    """
    sizes = program.sizes
    n, nodes, first, spent = sizes.actuators, sizes.nodes, program.frame.strokes, 0
    strokes, speeds = work.before[:n], work.before[n:]
    copy(strokes, work.frame[first : first + n])
    copy(speeds, work.frame[nodes : nodes + n])
    t_strokes, t_speeds = work.rows_before[:n], work.rows_before[n:]
    if tangents_by:
        copy_rows(t_strokes, work.tangents[first : first + n])
        copy_rows(t_speeds, work.tangents[nodes : nodes + n])
    for _ in range(machine.steps):
        spent += step(program, machine, work, history, machine.tick_s / machine.steps, tangents_by)
    # A twin guarantees that strokes are the trapezoidal integral of its velocity outputs.
    start = StrokeStart(strokes, speeds, t_strokes, t_speeds)
    move_strokes(program, machine, work, 0.5 * machine.tick_s, start)
    return spent
