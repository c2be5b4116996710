"""Time stepping of a grey box: one sample of one run, with exact tangents by parameters or by the previous state."""

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
AHEAD = (1.0 - GAMMA) / GAMMA
"""The base of the second stage lies on the line through the start and the first stage, this far beyond the latter."""
ITERATIONS = 30
TOLERANCE = 1e-9
"""Of a Newton step, in MPa and m/s: what is left is far below the rounding of single precision."""
LARGEST = 4.0
"""MPa by which an iteration may move a pressure: the slope of a square root says little about what is far away."""


class MachineArrays(NamedTuple):
    """Parameters and constants of one machine.

    Attributes:
        parameters: shape (parameter,).
        constants: see `edp.networks.twin.grey.equations.GreyForm.constants`.
        scale: of the strokes; 0 where a stroke is not measured, shape (actuator,).
        linkage: of `edp.networks.twin.grey.parameter_index`; empty if the load is a polynomial of the strokes.
        ports: kind and number of the state behind each output, shape (output, 2).
        tick_s: length of a sample, s.
        steps: implicit steps in it.
    """

    parameters: Array
    constants: Array
    scale: Array
    linkage: Array
    ports: IntArray
    tick_s: float
    steps: int


class RunValues(NamedTuple):
    """Values of one run, and room for results.

    Attributes:
        frame: inputs of all functions, see `edp.networks.twin.grey.program.FramePlaces`.
        tangents: of its first values, shape (value, column).
        own: tangents of the valves by their own parameters, shape (valve * state, OWN).
        out: results of functions.
        contents: of the nodes, then velocities, shape (unknown,).
        rows: further tangents of unknowns, shape (unknown, column).
        states: tangents of the valves after a step, shape (valve * state, OWN).
        before: strokes and velocities before the sample, shape (2 * actuator,).
        rows_before: their tangents, shape (2 * actuator, column).
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
    """Return zeros for a run with this number of tangents."""
    n, valves, _, nodes, _ = program.sizes
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
    """Copy values; a loop compiles in a tenth of the time of an assignment to a slice."""
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
    """LU in place, without pivots: pressures come first, and their rows are dominated by the diagonal."""
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
    """Replace the columns ``(unknown, column)`` by the solutions."""
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
    """Solve a stage for the unknowns, from a guess, until they move by less than `tolerance`; return the iterations."""
    nodes, size = program.sizes[3], len(work.contents)
    y, change = work.frame[:size], work.out
    share, before, at_before = 1.0, 0.0, -1
    for iteration in range(ITERATIONS):
        call(program.addresses[code.NEWTON], machine.parameters, machine.constants, work.frame, work.out)
        most = 0
        for k in range(1, size):
            if abs(change[k]) > abs(change[most]):
                most = k
        largest = change[most]
        # Where a check or a relief toggles, whole steps would go to and fro for ever.
        to_and_fro = most == at_before and largest * before < 0.0 and abs(largest) > 0.5 * abs(before)
        share = max(0.5 * share, 0.125) if to_and_fro else min(2.0 * share, 1.0)
        before, at_before = largest, most
        for k in range(nodes):
            moved = min(max(share * change[k], -LARGEST), LARGEST)
            # Towards a vacuum by shares of what is left: the content has a pole there.
            y[k] = max(y[k] - moved, 0.25 * (y[k] + at.ATMOSPHERE) - at.ATMOSPHERE)
        for k in range(nodes, size):
            y[k] -= share * change[k]
        if abs(largest) < tolerance:
            return iteration + 1
    return ITERATIONS


@inlined
def _add_rows(program: GreyProgram, group: int, work: RunValues, target: Array, sign: float) -> None:
    """Add derivatives times the tangents of their variables to the tangents of the results."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        slope = sign * work.out[first + e - begin]
        if slope != 0.0:
            row, column = program.entries[e]
            for k in range(target.shape[1]):
                target[row, k] += slope * work.tangents[column, k]


@inlined
def _add_numbers(program: GreyProgram, group: int, work: RunValues, target: Array, sign: float) -> None:
    """Add derivatives by parameters, each of which is a column."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        row, column = program.entries[e]
        target[row, column] += sign * work.out[first + e - begin]


@inlined
def _add_own(program: GreyProgram, group: int, state: int, work: RunValues, target: Array, sign: float) -> None:
    """Add derivatives by a state of each valve, whose tangents are by its own parameters."""
    first, begin, end = program.groups[group]
    for e in range(begin, end):
        slope = sign * work.out[first + e - begin]
        row, j = program.entries[e]
        for k in range(at.OWN):
            target[row, program.own[j, k]] += slope * work.own[at.VALVE_STATES * j + state, k]


@inlined
def _goal_slope(machine: MachineArrays, program: GreyProgram, history: Array, j: int) -> float:
    """Return the derivative of a valve's command one dead time ago by the dead time."""
    ticks = machine.parameters[program.own[j, at.BY_DELAY]] / machine.tick_s
    if not 0.0 <= ticks <= len(history) - 2.0:
        return 0.0
    whole = min(int(ticks), len(history) - 2)
    return float((history[whole + 1, j] - history[whole, j]) / machine.tick_s)


@inner
def advance_valves(
    program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, length: float, by_numbers: bool
) -> None:
    """Move all valves on by `length` seconds, with the tangents by their own parameters."""
    frame, out, count = work.frame, work.out, program.sizes[1]
    for j in range(count):
        delay = machine.parameters[program.own[j, at.BY_DELAY]]
        ticks = min(max(delay / machine.tick_s, 0.0), len(history) - 2.0)
        whole = min(int(ticks), len(history) - 2)
        newer, older = history[whole, j], history[whole + 1, j]
        frame[program.frame.goals + j] = newer + (ticks - whole) * (older - newer)
    frame[program.frame.length] = length
    call(program.addresses[code.VALVES], machine.parameters, machine.constants, frame, out)
    states = count * at.VALVE_STATES
    if by_numbers:
        clear_rows(work.states)
        first_slope, begin, end = program.groups[code.VALVE_STATES]
        for e in range(begin, end):
            slope = out[first_slope + e - begin]
            row, column = program.entries[e]
            if column < states:
                for k in range(at.OWN):
                    work.states[row, k] += slope * work.own[column, k]
            else:
                work.states[row, at.BY_DELAY] += slope * _goal_slope(machine, program, history, column - states)
        _add_numbers(program, code.VALVE_OWN, work, work.states, 1.0)
        copy_rows(work.own, work.states)
    first = program.frame.valves
    copy(frame[first : first + states], out)


@inner
def move_pumps(program: GreyProgram, machine: MachineArrays, work: RunValues, length: float, columns_by: int) -> None:
    """Move the displacements of all pumps on by `length` seconds, with their tangents."""
    first, count = program.frame.displacements, program.sizes[2]
    work.frame[program.frame.length] = length
    call(program.addresses[code.PUMPS], machine.parameters, machine.constants, work.frame, work.out)
    if columns_by and count > 0:
        after = work.rows[:count]
        clear_rows(after)
        _add_rows(program, code.PUMP_FRAME, work, after, 1.0)
        if columns_by == at.BY_NUMBERS:
            _add_own(program, code.PUMP_PILOTS, at.PILOT_2, work, after, 1.0)
            _add_numbers(program, code.PUMP_NUMBERS, work, after, 1.0)
        copy_rows(work.tangents[first : first + count], after)
    copy(work.frame[first : first + count], work.out)


@inner
def move_bristles(program: GreyProgram, machine: MachineArrays, work: RunValues, columns_by: int) -> None:
    """Compute the deflections after a stage from those of its base, with their tangents."""
    (n, _, _, nodes, _), frame = program.sizes, program.frame
    call(program.addresses[code.BRISTLES], machine.parameters, machine.constants, work.frame, work.out)
    for i in range(n):
        work.frame[frame.bristles + i] = work.out[i]
    if columns_by:
        for i in range(n):
            by_speed, by_before = work.out[n + i], work.out[2 * n + i]
            for k in range(work.tangents.shape[1]):
                work.tangents[frame.bristles + i, k] = (
                    by_before * work.tangents[frame.bristle_base + i, k] + by_speed * work.tangents[nodes + i, k]
                )
    if columns_by == at.BY_NUMBERS:
        _add_numbers(program, code.BRISTLE_NUMBERS, work, work.tangents[frame.bristles :], 1.0)


@inner
def fill_contents(
    program: GreyProgram, machine: MachineArrays, work: RunValues, contents: Array, tangents: Array, columns_by: int
) -> None:
    """Compute the contents of the nodes and the velocities, with their tangents."""
    nodes, size = program.sizes[3], len(contents)
    call(program.addresses[code.CONTENTS], machine.parameters, machine.constants, work.frame, work.out)
    copy(contents[:nodes], work.out)
    copy(contents[nodes:], work.frame[nodes:size])
    if columns_by:
        copy_rows(tangents[nodes:size], work.tangents[nodes:size])
        for k in range(nodes):
            slope = work.out[nodes + k]
            for c in range(work.tangents.shape[1]):
                tangents[k, c] = slope * work.tangents[k, c]
    if columns_by == at.BY_NUMBERS:
        _add_numbers(program, code.CONTENT_NUMBERS, work, tangents, 1.0)


@inner
def stage_tangents(program: GreyProgram, machine: MachineArrays, work: RunValues, columns_by: int) -> None:
    """Tangents of the unknowns after a stage: ``R_y y' = -(R_q + R_u u')``, by one factorisation for all columns."""
    size = len(work.contents)
    call(program.addresses[code.SLOPES], machine.parameters, machine.constants, work.frame, work.out)
    solved = work.tangents[:size]
    clear_rows(solved)
    _add_rows(program, code.BY_FRAME, work, solved, -1.0)
    if columns_by == at.BY_NUMBERS:
        _add_own(program, code.BY_SPOOL, at.SPOOL, work, solved, -1.0)
        _add_numbers(program, code.BY_NUMBER, work, solved, -1.0)
    by_y = work.out[: size * size].reshape(size, size)
    factorise(by_y)
    solve(by_y, solved)


@inlined
def _extrapolate(base: Array, reached: Array) -> None:
    """Move the tangents of a base along the line to those of the first stage, to the base of the second."""
    for row in range(len(base)):
        for k in range(base.shape[1]):
            base[row, k] += AHEAD * (reached[row, k] - base[row, k])


@inner
def freeze(program: GreyProgram, machine: MachineArrays, work: RunValues, length: float, columns_by: int) -> None:
    """Compute the strokes in the middle of a step of `length` seconds, and the load there."""
    (n, _, _, nodes, _), frame, values = program.sizes, program.frame, work.frame
    for i in range(n):
        half = 0.5 * length if machine.scale[i] > 0.0 else 0.0
        values[frame.speeds + i] = values[nodes + i]
        values[frame.frozen + i] = values[frame.strokes + i] + half * values[nodes + i]
        if columns_by:
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


@inner
def move_strokes(
    program: GreyProgram,
    machine: MachineArrays,
    work: RunValues,
    half: float,
    before: tuple[Array, Array],
    speeds: tuple[Array, Array],
) -> None:
    """Integrate the strokes by the trapezoidal rule, with their tangents.

    Args:
        program: of the machine.
        machine: its parameters.
        work: values of the run.
        half: half of the time, s.
        before: strokes before, and their tangents.
        speeds: velocities before, and their tangents.
    """
    (n, _, _, nodes, _), first = program.sizes, program.frame.strokes
    for i in range(n):
        # A stroke that is not measured has no scale, and nothing depends on it: it stays where it is.
        weight = half if machine.scale[i] > 0.0 else 0.0
        work.frame[first + i] = before[0][i] + weight * (speeds[0][i] + work.frame[nodes + i])
        for k in range(before[1].shape[1]):
            moved = weight * (speeds[1][i, k] + work.tangents[nodes + i, k])
            work.tangents[first + i, k] = before[1][i, k] + moved


@inner
def step(
    program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, length: float, columns_by: int
) -> int:
    """Advance one run by one implicit step of `length` seconds; return the iterations."""
    (n, _, _, nodes, _), frame = program.sizes, program.frame
    values, tangents, size, spent = work.frame, work.tangents, nodes + program.sizes[0], 0
    freeze(program, machine, work, length, columns_by)
    base, z = values[frame.base : frame.base + size], values[frame.bristles : frame.bristles + n]
    base_z = values[frame.bristle_base : frame.bristle_base + n]
    t_base = tangents[frame.base : frame.base + size]
    fill_contents(program, machine, work, base, t_base, columns_by)
    copy(base_z, z)
    if columns_by:
        copy_rows(tangents[frame.bristle_base : frame.bristle_base + n], tangents[frame.bristles : frame.bristles + n])
    values[frame.step] = GAMMA * length
    for which in range(2):
        moved = GAMMA * length if which == 0 else length - GAMMA * length
        advance_valves(program, machine, work, history, moved, columns_by == at.BY_NUMBERS)
        if which == 0:
            move_pumps(program, machine, work, length, columns_by)
        half = 0.5 * (GAMMA * length if which == 0 else length)
        values[frame.half] = half
        for i in range(n):
            values[frame.reached + i] = values[frame.strokes + i] + half * values[frame.speeds + i]
            if columns_by:
                for k in range(tangents.shape[1]):
                    tangents[frame.reached + i, k] = (
                        tangents[frame.strokes + i, k] + half * tangents[frame.speeds + i, k]
                    )
        spent += newton(program, machine, work, TOLERANCE)
        if columns_by:
            stage_tangents(program, machine, work, columns_by)
        move_bristles(program, machine, work, columns_by)
        if which == 0:
            fill_contents(program, machine, work, work.contents, work.rows, columns_by)
            for k in range(size):
                base[k] += AHEAD * (work.contents[k] - base[k])
            for i in range(n):
                base_z[i] += AHEAD * (z[i] - base_z[i])
            if columns_by:
                _extrapolate(t_base, work.rows)
                _extrapolate(
                    tangents[frame.bristle_base : frame.bristle_base + n],
                    tangents[frame.bristles : frame.bristles + n],
                )
    strokes = values[frame.strokes : frame.strokes + n], tangents[frame.strokes : frame.strokes + n]
    speeds = values[frame.speeds : frame.speeds + n], tangents[frame.speeds : frame.speeds + n]
    move_strokes(program, machine, work, 0.5 * length, strokes, speeds)
    return spent


@inner
def tick(program: GreyProgram, machine: MachineArrays, work: RunValues, history: Array, columns_by: int) -> int:
    """Advance one run by one sample.

    Args:
        program: of the machine.
        machine: its parameters.
        work: values of the run; moved.
        history: commands of the valves, shape (tick, valve), newest first.
        columns_by: by what tangents are carried along: `parameter_index.NONE`, `BY_NUMBERS` or `BY_STATE`.

    Returns:
        Iterations of all stages together.
    """
    (n, _, _, nodes, _), first, spent = program.sizes, program.frame.strokes, 0
    strokes, speeds = work.before[:n], work.before[n:]
    copy(strokes, work.frame[first : first + n])
    copy(speeds, work.frame[nodes : nodes + n])
    t_strokes, t_speeds = work.rows_before[:n], work.rows_before[n:]
    if columns_by:
        copy_rows(t_strokes, work.tangents[first : first + n])
        copy_rows(t_speeds, work.tangents[nodes : nodes + n])
    for _ in range(machine.steps):
        spent += step(program, machine, work, history, machine.tick_s / machine.steps, columns_by)
    # What a twin promises: a stroke is the trapezoidal integral of the velocities that it answers, one a sample.
    move_strokes(program, machine, work, 0.5 * machine.tick_s, (strokes, t_strokes), (speeds, t_speeds))
    return spent
