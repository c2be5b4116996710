"""Responses of a twin to a step of one command with constant other commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from edp.data.series import Series
from edp.evaluation.free_run_file import CommandStep, StepAnswer, StepResponses
from edp.networks.twin import Twin, even_starts
from edp.signals import KINDS, Channel

LENGTH_S = 2.0
"""Length of a response in s, within which a hydraulic axis settles."""
MOMENTS, MAX_STARTS = 24, 8
"""Number of steps whose median response is shown, and maximum number of steps per recording."""
POINTS, MAX_COMMANDS = 100, 12
SPAN = (0.05, 0.95)
"""Quantiles that define the range of a command. The step is half of this range."""


def step_responses(twin: Twin, series: Sequence[Series]) -> StepResponses:
    """Return the differences between free runs with and without a step of a command, from samples of recordings.

    At each moment all commands are held as they are. Once one of them jumps by half of its range, towards the middle of
    it, and the difference is counted as that of a jump upwards: the response is what the jump alone does.

    Args:
        twin: any formulation.
        series: inputs are commands, targets are what it answers.

    Returns:
        Responses in units of reports.

    Raises:
        DataError: no segment is long enough.
    """
    channels, prefix = twin.channels, twin.prefix_ticks
    starts = even_starts(twin, series, prefix + 1, MAX_STARTS)
    chosen = np.unique(np.linspace(0, len(starts) - 1, MOMENTS).astype(np.int64))
    lanes = [starts[i] for i in chosen]
    before = np.stack([part.inputs[at : at + prefix] for part, at in lanes])
    measured = np.stack([part.targets[at : at + prefix] for part, at in lanes])
    ticks = max(2, round(LENGTH_S * channels.rate_hz))
    constant = np.repeat(before[:, -1:], ticks, axis=1)
    rows = np.unique(np.linspace(0, ticks - 1, POINTS).astype(np.int64))
    low, middle, high = np.quantile(np.concatenate([part.inputs for part in series]), (SPAN[0], 0.5, SPAN[1]), axis=0)
    steps = []
    with threadpool_limits(limits=1, user_api="blas"):
        base = twin.rollout(constant, twin.reset(before, measured))[0]
        for column, command in enumerate(channels.commands[:MAX_COMMANDS]):
            size = 0.5 * float(high[column] - low[column])
            if not size > 0.0:
                continue
            upwards = np.where(before[:, -1, column] <= middle[column], 1.0, -1.0)
            stepped = constant.copy()
            stepped[:, :, column] += (size * upwards)[:, None].astype(stepped.dtype)
            answers = twin.rollout(stepped, twin.reset(before, measured))[0]
            change = (answers - base)[:, rows] * upwards[:, None, None]
            steps.append(_step(command, size, change, channels.answers))
    seconds = tuple(((rows + 1) / channels.rate_hz).tolist())
    return StepResponses(seconds=seconds, moments=len(lanes), steps=tuple(steps))


def _step(command: Channel, size: float, change: Any, answers: Sequence[Channel]) -> CommandStep:
    facts = KINDS[command.kind]
    entries = []
    for column, channel in enumerate(answers):
        kind = KINDS[channel.kind]
        values = kind.report_factor * change[:, :, column].astype(np.float64)
        ends = np.quantile(values, (0.1, 0.9), axis=0)
        lines = {"median": np.median(values, axis=0), "low": ends[0], "high": ends[1]}
        rounded = {name: tuple(float(f"{value:.4g}") for value in line) for name, line in lines.items()}
        entries.append(StepAnswer(name=channel.name, unit=kind.report_unit, **rounded))
    return CommandStep(
        command=command.description or command.name,
        size=float(f"{facts.report_factor * size:.3g}"),
        unit=facts.report_unit,
        answers=tuple(entries),
    )
