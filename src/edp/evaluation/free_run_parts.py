"""Parts of free-run scores: by horizon, by recording, at end stops and standstill.

Separate for each kind of channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.evaluation.free_run_file import (
    ChannelErrors,
    ErrorLine,
    HorizonErrors,
    MotionErrors,
    PressureErrors,
    RunSummary,
    StrokeErrors,
)
from edp.signals import KINDS, Channel

Array = NDArray[np.float32]
AT_STOP = 0.01
"""Fraction of a stroke: distance from an end stop within which an actuator is at the stop."""
AT_REST = 0.01
"""Fraction of a twin's maximum velocity below which an actuator does not move, unless it is at an end stop."""
HORIZONS_A_DECADE = 6
"""Number of horizons per decade for which errors are stored, sufficient for a chart with a logarithmic axis."""


def by_channel(channels: Sequence[Channel], values: NDArray[Any], integral: bool = False) -> ChannelErrors:
    """Return the mean of each channel in report units, and over all channels if they share a unit.

    Args:
        channels: channels of the columns.
        values: SI units, ``(channel,)`` or ``(run, channel)``.
        integral: whether they are integrals of the channels over seconds.
    """
    unit_of = {channel.name: KINDS[channel.kind].report_unit for channel in channels}
    if integral:
        unit_of = {name: unit.removesuffix("/s") for name, unit in unit_of.items()}
    units = set(unit_of.values())
    unit = units.pop() if len(units) == 1 else None
    by_run = _convert_to_report_units(channels, values)
    return ChannelErrors(
        unit=unit,
        by_channel={c.name: float(x) for c, x in zip(channels, by_run.mean(axis=0), strict=True)},
        units=unit_of if len(unit_of) > 1 and unit is None else {},
        mean=None if unit is None or not by_run.size else float(by_run.mean()),
    )


def stroke_errors(channels: Sequence[Channel], at_s: float, values: NDArray[Any], integral: bool) -> StrokeErrors:
    """Return the means of `by_channel` of runs ``(run, channel)`` at a time, with the median over runs."""
    means = by_channel(channels, values, integral)
    median = None if means.unit is None else float(np.median(_convert_to_report_units(channels, values)))
    return StrokeErrors(at_s=at_s, **vars(means), median=median)


def _convert_to_report_units(channels: Sequence[Channel], values: NDArray[Any]) -> NDArray[Any]:
    """Return values ``(run, channel)`` in units of reports."""
    return np.atleast_2d(values * np.array([KINDS[channel.kind].report_factor for channel in channels]))


def nrmse_by_channel(
    channels: TwinChannels, answers: Array, truth: Array, ticks: NDArray[np.bool_] | None = None
) -> PressureErrors:
    """Return the root mean square error of each pressure in its deviations over all runs, and their mean.

    Args:
        channels: channels of the twin.
        answers: ``(run, tick, output)``, SI units; `truth` likewise.
        truth: measured.
        ticks: mask of samples that count ``(run, tick)``; all by default.
    """
    columns = channels.parts["pressures"]
    spread = truth[..., columns].astype(np.float64).std(axis=(0, 1))
    errors = (answers - truth)[..., columns].astype(np.float64)
    chosen = errors[np.ones(errors.shape[:2], dtype=bool) if ticks is None else ticks]
    squares = np.square(chosen).mean(axis=0) if len(chosen) else np.full(len(spread), np.nan)
    # A pressure that does not move has no scale to measure its error by.
    each = [float(np.sqrt(s) / d) if d > 0 and np.isfinite(s) else None for s, d in zip(squares, spread, strict=True)]
    numbers = [value for value in each if value is not None]
    return PressureErrors(
        mean=float(np.mean(numbers)) if numbers else None,
        by_channel={c.name: value for c, value in zip(channels.pressures, each, strict=True)},
    )


def by_horizon(channels: TwinChannels, errors: Array, stroke_errors: NDArray[np.float64]) -> HorizonErrors:
    """Return the mean absolute error of each output at geometrically spaced horizons, in report units.

    Args:
        channels: channels of the twin.
        errors: ``(run, tick, output)``, SI units.
        stroke_errors: errors of strokes, or of integrated velocities without measured strokes ``(run, tick,
            velocity)``.
    """
    longest = errors.shape[1]
    count = max(2, round(HORIZONS_A_DECADE * np.log10(longest)) + 1)
    ticks = np.unique(np.geomspace(1, longest, count).round().astype(np.int64))
    lines = {}
    for part, columns in channels.parts.items():
        named, integral = channels.answers[columns], False
        values = np.abs(errors[:, ticks - 1][..., columns]).astype(np.float64)
        if part == "strokes" and not named:
            named, integral, values = channels.velocities, True, stroke_errors[:, ticks - 1]
        means = [by_channel(named, row, integral) for row in values.mean(axis=0)] if named else []
        lines[part] = ErrorLine(
            unit=means[0].unit if means else None,
            mean=tuple(row.mean for row in means),
            by_channel={c.name: tuple(row.by_channel[c.name] for row in means) for c in named},
        )
    return HorizonErrors(seconds=tuple(float(tick / channels.rate_hz) for tick in ticks), **lines)


def by_name(names: Sequence[str], summary: Callable[[NDArray[np.int64]], RunSummary]) -> dict[str, RunSummary]:
    """Return a summary of the runs of each name, in the order of first occurrence."""
    return {name: summary(np.flatnonzero(np.array(names) == name)) for name in dict.fromkeys(names)}


def situations(
    channels: TwinChannels, answers: Array, truth: Array, low: Array, high: Array
) -> dict[str, MotionErrors]:
    """Return the errors at end stops, at standstill and in motion by the measurement; absent situations are omitted.

    An actuator is at an end stop within `AT_STOP` of its stroke, in steady state where it is slower than `AT_REST` of
    its fastest velocity. The machine is at a stop where an actuator is, and in steady state (idling) where all of them
    are: that is what counts for pressures, whose pumps serve several actuators.

    Args:
        channels: channels of the twin.
        answers: ``(run, tick, output)``, SI units; `truth` likewise.
        truth: measured.
        low: least value of each output; `high` likewise.
        high: largest value.
    """
    velocities, strokes = channels.parts["velocities"], channels.parts["strokes"]
    rest = np.abs(truth[..., velocities]) < AT_REST * high[velocities]
    stop = np.zeros_like(rest)
    if channels.strokes:
        near = AT_STOP * (high - low)[strokes]
        stop = (truth[..., strokes] < low[strokes] + near) | (truth[..., strokes] > high[strokes] - near)
    rest &= ~stop
    machine_stop: NDArray[np.bool_] = np.asarray(stop.any(axis=-1))
    machine_rest: NDArray[np.bool_] = np.asarray(rest.all(axis=-1))
    machine = {"end_stops": machine_stop, "rest": machine_rest, "motion": ~machine_stop & ~machine_rest}
    rows = {}
    for name, axes in {"end_stops": stop, "rest": rest, "motion": ~stop & ~rest}.items():
        ticks = machine[name]
        if not axes.any() and not ticks.any():
            continue
        errors = np.abs(answers - truth)
        rows[name] = MotionErrors(
            share=float(axes.mean()),
            machine_share=float(ticks.mean()),
            velocity_mae=_where(channels.velocities, errors[..., velocities], axes),
            stroke_error=_where(channels.strokes, errors[..., strokes], axes) if channels.strokes else None,
            pressure_nrmse=nrmse_by_channel(channels, answers, truth, ticks),
        )
    return rows


def _where(channels: Sequence[Channel], errors: Array, axes: NDArray[np.bool_]) -> ChannelErrors:
    """Return the mean of each channel over its own samples; None without any, and then without a mean over channels."""
    counts = axes.sum(axis=(0, 1))
    sums = np.where(axes, errors.astype(np.float64), 0.0).sum(axis=(0, 1))
    seen = [i for i, count in enumerate(counts) if count]
    row = by_channel([channels[i] for i in seen], sums[seen] / counts[seen])
    return replace(row, by_channel={channel.name: row.by_channel.get(channel.name) for channel in channels})
