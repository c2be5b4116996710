"""Scales between SI units and a twin's internal units: offsets, widths, and output bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from edp.data.scaling import CONSTANT
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.signals import KINDS

Array = NDArray[np.float32]
FASTEST = 1.25
"""Bound of a predicted velocity, as a multiple of the highest velocity in the training data."""
HIGHEST = 1.1
"""Bound of a predicted pressure, as a multiple of the highest pressure in the training data, which a relief valve
limited."""


@dataclass(frozen=True, eq=False)
class TwinScales:
    """Scales fitted to the training data once; every array is float32 in SI units.

    Attributes:
        command_offset: ``(command,)``.
        command_width: ``(command,)``, positive.
        answer_offset: ``(output,)``; zero for velocities, so that a scaled sign is a direction.
        answer_width: ``(output,)``, positive.
        change_width: ``(output,)``: deviation of the change from tick to tick, positive.
        low: ``(output,)``: least value of an output; of a stroke the closed end stop.
        high: ``(output,)``: largest value; of a stroke the open end stop.
    """

    command_offset: Array
    command_width: Array
    answer_offset: Array
    answer_width: Array
    change_width: Array
    low: Array
    high: Array

    def arrays(self) -> dict[str, Array]:
        """Return the fields by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    @staticmethod
    def shapes(channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the shape of each array."""
        commands, answers = len(channels.commands), len(channels.answers)
        return {e.name: (commands if e.name.startswith("command") else answers,) for e in fields(TwinScales)}

    @staticmethod
    def from_arrays(arrays: Mapping[str, Array]) -> TwinScales:
        """Create scales from arrays by name; other arrays are ignored.

        Raises:
            ValueError: a width that is not positive, or bounds in the wrong order.
        """
        scales = TwinScales(**{entry.name: arrays[entry.name] for entry in fields(TwinScales)})
        for name in ("command_width", "answer_width", "change_width"):
            if not (getattr(scales, name) > 0).all():
                raise ValueError(f"its {name} holds a number that is not positive")
        if not (scales.low < scales.high).all():
            raise ValueError("a bound of its answers is not below the other")
        return scales

    def trapezoid(self, channels: TwinChannels) -> Array:
        """Return scaled stroke per tick for the sum of two scaled velocities ``(stroke,)``: the trapezoidal rule."""
        count, first = len(channels.strokes), len(channels.velocities)
        widths = self.answer_width[first : first + count]
        return np.asarray(self.answer_width[:count] / (2.0 * channels.rate_hz * widths), dtype=np.float32)


def fit_scales(channels: TwinChannels, train: Sequence[Series]) -> TwinScales:
    """Fit scales and bounds to the training segments.

    End stops are the ends of the strokes that were seen: a twin does not leave where it was trained.
    """
    commands = np.concatenate([series.inputs for series in train]).astype(np.float64)
    answers = np.concatenate([series.targets for series in train]).astype(np.float64)
    changes = np.concatenate([np.diff(series.targets, axis=0) for series in train]).astype(np.float64)
    count, strokes = len(channels.velocities), len(channels.strokes)
    offset = answers.mean(axis=0)
    offset[:count] = 0.0
    width = _widths(answers - offset, [KINDS[channel.kind].nominal for channel in channels.answers])
    low, high = answers.min(axis=0), answers.max(axis=0)
    low[:count], high[:count] = -FASTEST * np.abs(answers[:, :count]).max(axis=0), 0.0
    high[:count] = -low[:count]
    # Gauges of cavitating chambers read a little below zero; oil has no negative absolute pressure to follow them to.
    low[count + strokes :], high[count + strokes :] = 0.0, HIGHEST * np.maximum(high[count + strokes :], 0.0)
    high = np.maximum(high, low + CONSTANT * width)
    numbers = {
        "command_offset": commands.mean(axis=0),
        "command_width": _widths(commands - commands.mean(axis=0), [KINDS[c.kind].nominal for c in channels.commands]),
        "answer_offset": offset,
        "answer_width": width,
        "change_width": _widths(changes, CONSTANT * width),
        "low": low,
        "high": high,
    }
    return TwinScales(**{name: np.ascontiguousarray(values, dtype=np.float32) for name, values in numbers.items()})


def _widths(values: NDArray[np.float64], constant: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return root mean squares; `constant` for columns that do not move."""
    deviations = np.sqrt(np.square(values).mean(axis=0))
    return np.where(deviations > CONSTANT * np.asarray(constant), deviations, np.asarray(constant))
