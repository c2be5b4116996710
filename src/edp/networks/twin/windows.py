"""Windows of recordings in which free runs are simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series

Singles = NDArray[np.float32]


class WindowStart(NamedTuple):
    """Segment of a recording and the first sample of a window in it."""

    series: Series
    first: int


@dataclass(frozen=True, eq=False)
class MeasuredWindows:
    """Commands and measured outputs of windows of equal length.

    Attributes:
        commands: commands ``(window, tick, command)``.
        outputs: measured outputs before each command and after the last one ``(window, tick + 1, output)``.
    """

    commands: Singles
    outputs: Singles

    @staticmethod
    def read(windows: Sequence[WindowStart], ticks: int) -> MeasuredWindows:
        """Copy windows with `ticks` commands. Behind the end of a segment its last command stays, outputs are NaN."""
        commands, outputs = [], []
        for series, first in windows:
            driven, measured = series.inputs[first : first + ticks], series.targets[first : first + ticks + 1]
            short = ticks + 1 - len(measured)
            commands.append(np.pad(driven[: len(measured) - 1], ((0, short), (0, 0)), mode="edge") if short else driven)
            outputs.append(np.pad(measured, ((0, short), (0, 0)), constant_values=np.nan) if short else measured)
        return MeasuredWindows(np.stack(commands), np.stack(outputs))


def random_windows(series: Sequence[Series], ticks: int, count: int, rng: np.random.Generator) -> list[WindowStart]:
    """Draw starts of windows with `ticks` commands. Each start is equally likely, so long segments count by length.

    Args:
        series: segments, of which one at least has more than `ticks` samples.
        ticks: length of the windows.
        count: number of windows.
        rng: random values.
    """
    starts = np.array([max(part.samples - ticks, 0) for part in series])
    ends = np.cumsum(starts)
    drawn = rng.integers(0, ends[-1], count)
    which = np.searchsorted(ends, drawn, side="right")
    return [
        WindowStart(series[part], int(first))
        for part, first in zip(which, drawn - ends[which] + starts[which], strict=True)
    ]
