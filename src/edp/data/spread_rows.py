"""Evenly spread stretches of data that are more than a computation over all rows could hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.data.series import Series
from edp.recording import Recording

MOST_ROWS = 1 << 22
"""Rows that screening and coverage hold at a time: eleven and a half hours at 100 Hz."""


def spread_stretches(lengths: Sequence[int], length: int, most: int = MOST_ROWS) -> list[tuple[int, int, int]]:
    """Stretches that are evenly spread over sequences of rows: number of the sequence, first row, one after the last.

    Args:
        lengths: rows of each sequence.
        length: rows of a stretch; shorter sequences are taken whole.
        most: rows in all, about; where the sequences hold no more, each is taken whole.
    """
    total = sum(lengths)
    if total <= most:
        return [(i, 0, rows) for i, rows in enumerate(lengths)]
    count = max(1, most // length)
    chosen = []
    # Middles of equal shares of all rows, so that every sequence has its share.
    middles = (np.arange(count) + 0.5) * (total / count)
    ends = np.cumsum(lengths)
    last = (-1, 0)
    for middle, i in zip(middles, np.searchsorted(ends, middles, side="right"), strict=True):
        rows = lengths[i]
        start = int(min(max(middle - (ends[i] - rows) - length / 2, 0), max(rows - length, 0)))
        # Near the ends of a sequence two middles may want the same rows.
        start = max(start, last[1]) if last[0] == i else start
        stop = min(start + length, rows)
        if start < stop:
            chosen.append((int(i), start, stop))
            last = (int(i), stop)
    return chosen


def spread_recordings(recordings: Sequence[Recording], seconds: float, most: int = MOST_ROWS) -> list[Recording]:
    """Recordings, or evenly spread stretches of them of so many seconds; samples on disk stay there."""
    length = max(1, round(seconds * recordings[0].rate_hz))
    stretches = spread_stretches([recording.samples for recording in recordings], length, most)
    return [
        recordings[i]
        if (start, stop) == (0, recordings[i].samples)
        else replace(
            recordings[i], values=recordings[i].values[start:stop], name=f"{recordings[i].name}[{start}:{stop}]"
        )
        for i, start, stop in stretches
    ]


def spread_series(series: Sequence[Series], length: int, most: int) -> list[Series]:
    """Series, or evenly spread stretches of `length` ticks of them, of `most` ticks in all, about."""
    stretches = spread_stretches([part.samples for part in series], length, most)
    return [_cut(series[i], start, stop) for i, start, stop in stretches]


def _cut(part: Series, start: int, stop: int) -> Series:
    if (start, stop) == (0, part.samples):
        return part
    rows = slice(start, stop)
    teacher_targets = None if part.teacher_targets is None else part.teacher_targets[rows]
    name = f"{part.name}[{start}:{stop}]"
    return replace(
        part, name=name, inputs=part.inputs[rows], targets=part.targets[rows], teacher_targets=teacher_targets
    )
