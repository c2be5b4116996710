"""Detection of commands outside a twin's training range, where its errors and intervals have not been validated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.evaluation.free_run_file import CommandExcess
from edp.wording import figure

MARGIN = 0.02
"""Fraction of a command's range by which the command may leave that range, for sensor noise."""
RANGES = "command_ranges"
"""Key of the ranges in the provenance of a twin."""


def command_ranges(channels: TwinChannels, series: Sequence[Series], before: Any = None) -> dict[str, list[float]]:
    """Return the least and largest value of each command, SI units, by name.

    Args:
        channels: channels of the twin.
        series: training series.
        before: ranges of the initial twin, if the training continued one.
    """
    low = np.min([part.inputs.min(axis=0) for part in series], axis=0)
    high = np.max([part.inputs.max(axis=0) for part in series], axis=0)
    ranges = {c.name: [float(a), float(b)] for c, a, b in zip(channels.commands, low, high, strict=True)}
    for name, taught in before.items() if isinstance(before, Mapping) else ():
        if name in ranges and (ends := _ends(taught)):
            ranges[name] = [min(ranges[name][0], ends[0]), max(ranges[name][1], ends[1])]
    return ranges


def commands_beyond(ranges: Any, channels: TwinChannels, inputs: Sequence[NDArray[Any]]) -> dict[str, CommandExcess]:
    """Return the commands that leave their ranges, by name.

    Args:
        ranges: content of a file written by `command_ranges`. Commands without two numbers are ignored.
        channels: channels of the twin.
        inputs: commands ``(tick, command)``, SI units.
    """
    beyond: dict[str, CommandExcess] = {}
    if not isinstance(ranges, Mapping) or not inputs:
        return beyond
    values = np.concatenate([np.asarray(rows, dtype=np.float64) for rows in inputs])
    for column, channel in enumerate(channels.commands):
        ends = _ends(ranges.get(channel.name))
        if ends is None:
            continue
        low, high = ends
        margin, own = MARGIN * (high - low), values[:, column]
        share = float(((own < low - margin) | (own > high + margin)).mean())
        if share > 0.0:
            extremes = {"least": float(own.min()), "largest": float(own.max())}
            beyond[channel.name] = CommandExcess(share=share, low=low, high=high, **extremes)
    return beyond


def _ends(value: Any) -> tuple[float, float] | None:
    """Return two finite ascending values; None for any other value."""
    if not isinstance(value, list) or len(value) != 2:
        return None
    if not all(isinstance(end, int | float) and math.isfinite(end) for end in value) or value[0] > value[1]:
        return None
    return float(value[0]), float(value[1])


def describe_excess(beyond: Mapping[str, CommandExcess]) -> str:
    """Return a warning about errors and intervals outside the training range; empty within the training range."""
    if not beyond:
        return ""
    listed = ", ".join(
        f"{name} ({figure(row.share, 2)} of the ticks, {figure(row.least, 3)} to {figure(row.largest, 3)}; "
        f"learned from {figure(row.low, 3)} to {figure(row.high, 3)})"
        for name, row in sorted(beyond.items(), key=lambda pair: -pair[1].share)
    )
    return f"commands beyond all that taught the twin: {listed}; intervals promise nothing there"
