"""Rank correlations: Spearman's over all rows, Kendall's tau-b over evenly spread ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.screening.compiled import compiled, spread
from edp.data.screening.result import Array
from edp.recording import FloatArray

Orders = NDArray[np.int64]


@compiled
def _rank(values: FloatArray, order: Orders, ranks: FloatArray) -> None:
    """Return ranks from 1 in the given sorting order; equal values have their mean rank."""
    n = len(values)
    start = 0
    while start < n:
        stop = start + 1
        while stop < n and values[order[stop]] == values[order[start]]:
            stop += 1
        shared = 0.5 * (start + 1 + stop)
        for row in range(start, stop):
            ranks[order[row]] = shared
        start = stop


def ranks_of(values: FloatArray) -> FloatArray:
    """Return the ranks of one channel, equal values sharing their mean rank.

    Float32 (halves are exact up to 8 million rows).
    """
    values = np.ascontiguousarray(values)
    ranks = np.empty(len(values), dtype=np.float32)
    _rank(values, np.argsort(values), ranks)
    return ranks


def rank_columns(values: FloatArray) -> FloatArray:
    """Return the ranks of every column, ``(row, channel)``, stored a channel after another."""
    ranks = spread(lambda i: ranks_of(values[:, i]), range(values.shape[1]))
    return np.stack(ranks).T


@compiled
def _dense(values: FloatArray, order: Orders, dense: NDArray[np.int32]) -> float:
    """Assign ranks to the distinct values in ascending order and return the number of pairs of equal values."""
    level, run, tied = 0, 1, 0.0
    dense[order[0]] = 0
    for row in range(1, len(values)):
        if values[order[row]] == values[order[row - 1]]:
            tied += run
            run += 1
        else:
            level += 1
            run = 1
        dense[order[row]] = level
    return tied


@compiled
def _swaps(keys: NDArray[np.int32], spare: NDArray[np.int32]) -> float:
    """Count the pairs out of order by merge sort. The sorted keys end in `keys` or `spare`."""
    n = len(keys)
    swaps = 0.0
    # Runs of eight are sorted by insertion, which is faster than merging for so few.
    for start in range(0, n, 8):
        stop = min(start + 8, n)
        for i in range(start + 1, stop):
            key = keys[i]
            j = i
            while j > start and keys[j - 1] > key:
                keys[j] = keys[j - 1]
                j -= 1
            keys[j] = key
            swaps += i - j
    width = 8
    while width < n:
        for start in range(0, n, 2 * width):
            middle = min(start + width, n)
            stop = min(start + 2 * width, n)
            i, j = start, middle
            for row in range(start, stop):
                if j >= stop or (i < middle and keys[i] <= keys[j]):
                    spare[row] = keys[i]
                    i += 1
                else:
                    spare[row] = keys[j]
                    # All that is left of the lower run is larger: each is one pair out of order.
                    swaps += middle - i
                    j += 1
        keys, spare = spare, keys
        width *= 2
    return swaps


@compiled
def _tau(order: Orders, x: NDArray[np.int32], y: NDArray[np.int32], tied_x: float, tied_y: float) -> float:
    """Return Kendall's tau-b; `order` sorts x."""
    n = len(x)
    keys = np.empty(n, dtype=np.int32)
    start = 0
    tied_both = 0.0
    while start < n:
        stop = start + 1
        level = x[order[start]]
        while stop < n and x[order[stop]] == level:
            stop += 1
        for row in range(start, stop):
            keys[row] = y[order[row]]
        if stop - start > 1:  # equal x never count as swaps, so they are put into the order of y
            keys[start:stop] = np.sort(keys[start:stop])
            run = 1
            for row in range(start + 1, stop):
                if keys[row] == keys[row - 1]:
                    tied_both += run
                    run += 1
                else:
                    run = 1
        start = stop
    swaps = _swaps(keys, np.empty(n, dtype=np.int32))
    pairs = 0.5 * n * (n - 1.0)
    agree = pairs - tied_x - tied_y + tied_both - 2.0 * swaps
    result: float = agree / (np.sqrt(pairs - tied_x) * np.sqrt(pairs - tied_y))
    return result


class Kendall:
    """Kendall's tau-b of the columns of a sample, ``(row, channel)``; sorts each column once."""

    def __init__(self, sample: FloatArray) -> None:
        self._orders, self._dense, self._tied = [], [], []
        for i in range(sample.shape[1]):
            values = np.ascontiguousarray(sample[:, i])
            order, dense = np.argsort(values), np.empty(len(values), dtype=np.int32)
            self._tied.append(_dense(values, order, dense))
            self._orders.append(order)
            self._dense.append(dense)

    def tau(self, i: int, j: int) -> float:
        """Return Kendall's tau of two columns; NaN if one is constant."""
        return float(_tau(self._orders[i], self._dense[i], self._dense[j], self._tied[i], self._tied[j]))

    def matrix(self, on_share: Callable[[float], None] | None = None) -> Array:
        """Return Kendall's tau of all pairs, ``(channel, channel)``."""
        count = len(self._orders)
        taus = np.eye(count)
        rows = spread(lambda i: [self.tau(i, j) for j in range(i)], range(1, count), on_share)
        for i, row in enumerate(rows, start=1):
            taus[i, :i] = taus[:i, i] = row
        return taus


def correlation(stretches: Sequence[FloatArray], rows: int = 32_768) -> Array:
    """Return Pearson's correlation of the columns over all rows, ``(channel, channel)``, in float64 (eq. 2.11)."""
    samples = sum(len(s) for s in stretches)
    mean = sum(s.sum(axis=0, dtype=np.float64) for s in stretches) / samples
    moments = np.zeros((len(mean), len(mean)))
    for stretch in stretches:
        for start in range(0, len(stretch), rows):
            part = stretch[start : start + rows] - mean
            moments += part.T @ part
    deviation = np.sqrt(np.diag(moments))
    result: Array = np.clip(moments / np.outer(deviation, deviation), -1.0, 1.0)
    return result
