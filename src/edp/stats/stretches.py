"""Which rows to take of more than a computation could hold, or is to look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
