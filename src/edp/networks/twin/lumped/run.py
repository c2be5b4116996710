"""Batched free-run simulation of tanks, masses and lags, compiled; complex values carry one derivative per run.

The imaginary part of a complex step is exact to rounding, so one code is the equations and their derivatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.lumped.constants import EDGE, EMPTY, SLIP, SPILL
from edp.networks.twin.lumped.jit import compiled, inner

Values = NDArray[Any]
"""Real array, or complex array whose imaginary part carries a derivative."""
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]
Wiring = tuple[Integers, Integers, Integers, Doubles, Doubles, Doubles, tuple[int, int, bool], float]
"""Rows of the elements, each with the place of its first number last, and what bounds and paces them.

Lags: command, column. Masses: command, column. Tanks: command of the pump or -1, tank above or -1, column of the level
or -1, hidden state or -1. Then low and high of each output, width of each command, (steps, velocities, whether strokes
are measured), and ticks in a second.
"""
SMALL = 1e-8
"""Argument below which log(1 + x) is computed as x (1 - x / 2), because 1 + x would lose digits."""


@inner
def _log_of_one_and(x: Any) -> Any:
    if x.real < SMALL:
        return x * (1.0 - 0.5 * x)
    return np.log(1.0 + x)


@inner
def ramp(value: Any, width: Any) -> Any:
    """Return a smooth maximum of zero and a value, rounded over the width."""
    share = value / width
    if share.real > 0.0:
        return width * (_log_of_one_and(np.exp(-share)) + share)
    return width * _log_of_one_and(np.exp(share))


@inner
def _tanh(x: Any) -> Any:
    # By an exponential that cannot overflow, whatever a step of the fit tries.
    if x.real < 0.0:
        fallen = np.exp(2.0 * x)
        return (fallen - 1.0) / (fallen + 1.0)
    fallen = np.exp(-2.0 * x)
    return (1.0 - fallen) / (1.0 + fallen)


@inner
def _clip(value: Any, low: float, high: float) -> Any:
    """Return the within bounds; a slope passes where no bound acts."""
    if value.real < low:
        return value * 0.0 + low
    if value.real > high:
        return value * 0.0 + high
    return value


@inner
def _move_lags(numbers: Values, command: Doubles, answer: Values, after: Values, wiring: Wiring) -> None:
    """Advance pressures by the exact step of a first-order lag."""
    lags, low, high, rate = wiring[0], wiring[3], wiring[4], wiring[7]
    for k in range(len(lags)):
        which, column, at = lags[k, 0], lags[k, 1], lags[k, 2]
        goal = numbers[at] * command[which] + numbers[at + 1]
        share = 1.0 - np.exp(-1.0 / (numbers[at + 2] * rate))
        after[column] = _clip(answer[column] + share * (goal - answer[column]), low[column], high[column])


@inner
def _move_masses(numbers: Values, command: Doubles, answer: Values, after: Values, wiring: Wiring) -> None:
    """Advance velocities by a half-implicit step and strokes by the trapezoidal rule, within the end stops."""
    masses, low, high, rate = wiring[1], wiring[3], wiring[4], wiring[7]
    steps, count, strokes = wiring[6]
    step = 1.0 / (rate * steps)
    for k in range(len(masses)):
        which, column, at = masses[k, 0], masses[k, 1], masses[k, 2]
        viscous, coulomb = numbers[at + 1], numbers[at + 3]
        leaning = viscous * numbers[at + 2]
        slip = SLIP * high[column]
        push = numbers[at] * command[which] - numbers[at + 4]
        velocity = answer[column]
        for _ in range(steps):
            side = _tanh(velocity / slip)
            damping = viscous + leaning * side
            steep = damping + (coulomb + leaning * velocity) * (1.0 - side * side) / slip
            velocity = velocity + step * (push - damping * velocity - coulomb * side) / (1.0 + step * steep)
        velocity = _clip(velocity, low[column], high[column])
        if strokes:
            end = count + column
            stroke = answer[end] + 0.5 * (answer[column] + velocity) / rate
            if (stroke.real > high[end] and velocity.real > 0.0) or (stroke.real < low[end] and velocity.real < 0.0):
                velocity = velocity * 0.0
            after[end] = _clip(stroke, low[end], high[end])
        after[column] = velocity


@inner
def _flows(numbers: Values, command: Doubles, levels: Values, work: Values, wiring: Wiring) -> None:
    """Write the rates of the levels, m/s, to row 0 of `work`, and outflow and overflow of each tank to rows 1 and 2."""
    tanks, widths, rate = wiring[2], wiring[5], wiring[7]
    for k in range(len(tanks)):
        pump, above, column, at = tanks[k, 0], tanks[k, 1], tanks[k, 2], tanks[k, 4]
        outflow, share = numbers[at + 2], levels[k]
        if column >= 0:
            share = (share - numbers[at + 5]) / numbers[at + 4]
        if pump >= 0:
            filled = numbers[at] * ramp(command[pump] - numbers[at + 1], EDGE * widths[pump])
        else:
            filled = numbers[at] * (work[1, above] + numbers[at + 1] * work[2, above])
        full = ramp(share, EDGE)
        if full.real < EMPTY:
            full = full * 0.0 + EMPTY
        out = np.exp(numbers[at + 3] * np.log(full))
        over = SPILL * rate * ramp(share - 1.0, EDGE)
        work[1, k], work[2, k] = out, over / outflow
        risen = filled - outflow * out - over
        work[0, k] = risen * numbers[at + 4] if column >= 0 else risen


@inner
def _fill_tanks(
    numbers: Values, command: Doubles, answer: Values, hidden: Values, after: Values, work: Values, wiring: Wiring
) -> None:
    """Advance levels by the midpoint rule; a measured velocity is the mean over the sample."""
    tanks, low, high, rate = wiring[2], wiring[3], wiring[4], wiring[7]
    steps, count, _ = wiring[6]
    step, now, half = 1.0 / (rate * steps), work[3], work[4]
    for k in range(len(tanks)):
        now[k] = answer[tanks[k, 2]] if tanks[k, 2] >= 0 else hidden[tanks[k, 3]]
    for _ in range(steps):
        _flows(numbers, command, now, work, wiring)
        half[:] = now + 0.5 * step * work[0]
        _flows(numbers, command, half, work, wiring)
        now += step * work[0]
    for k in range(len(tanks)):
        column = tanks[k, 2]
        if column >= 0:
            after[column] = _clip(now[k], low[column], high[column])
            speed = column - count
            after[speed] = _clip((after[column] - answer[column]) * rate, low[speed], high[speed])
        else:
            hidden[tanks[k, 3]] = now[k] * 0.0 if now[k].real < 0.0 else now[k]


@inner
def _tick(
    numbers: Values, command: Doubles, answer: Values, hidden: Values, after: Values, work: Values, wiring: Wiring
) -> None:
    """Advance one sample from the port readings: write the next outputs and the hidden levels."""
    after[:] = answer
    _move_masses(numbers, command, answer, after, wiring)
    _move_lags(numbers, command, answer, after, wiring)
    _fill_tanks(numbers, command, answer, hidden, after, work, wiring)


@compiled
def free_run(numbers: Values, commands: Doubles, answer: Values, hidden: Values, wiring: Wiring) -> Values:
    """Simulate outputs ``(run, tick, output)`` from commands only.

    Args:
        numbers: parameters of each run ``(run, number)``.
        commands: commands in SI units ``(run, tick, command)``.
        answer: outputs before the first sample ``(run, output)``.
        hidden: unmeasured levels before the first sample ``(run, level)``.
        wiring: see `Wiring`.
    """
    lanes, ticks = commands.shape[0], commands.shape[1]
    answers = np.empty((lanes, ticks, answer.shape[1]), answer.dtype)
    work = np.zeros((5, len(wiring[2])), answer.dtype)
    for lane in range(lanes):
        levels = hidden[lane].copy()
        for t in range(ticks):
            before = answers[lane, t - 1] if t else answer[lane]
            _tick(numbers[lane], commands[lane, t], before, levels, answers[lane, t], work, wiring)
    return answers


@compiled
def simulate_measured(
    numbers: Doubles,
    commands: NDArray[np.float32],
    measured: NDArray[np.float32],
    answer: NDArray[np.float32],
    hidden: NDArray[np.float32],
    wiring: Wiring,
) -> NDArray[np.float32]:
    """Simulate outputs ``(run, tick, output)``; a port reads the measurement, or the last output if it is NaN.

    The state is rounded in each sample, so that a continued simulation gives identical bits. `answer` and `hidden` are
    updated to the end of the run.
    """
    answers = np.empty(measured.shape, np.float32)
    work, read, after = np.zeros((5, len(wiring[2]))), np.zeros(answer.shape[1]), np.zeros(answer.shape[1])
    levels, command = np.zeros(hidden.shape[1]), np.zeros(commands.shape[2])
    for lane in range(len(answers)):
        for t in range(commands.shape[1]):
            for i in range(len(read)):
                read[i] = answer[lane, i] if np.isnan(measured[lane, t, i]) else measured[lane, t, i]
            levels[:], command[:] = hidden[lane], commands[lane, t]
            _tick(numbers, command, read, levels, after, work, wiring)
            answer[lane], hidden[lane] = after, levels
            answers[lane, t] = answer[lane]
    return answers
