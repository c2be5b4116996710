"""Sums over lagged rows, from which ridge maps of any history and penalty are solved without a second pass.

The Gram matrix of lagged inputs is nearly block Toeplitz: the block of lags (i + 1, j + 1) sums the same products as
that of (i, j), one tick earlier. So only the blocks (0, j) are summed over time; the others follow from the first and
last rows of each series. That is exact, and cheaper by the number of lags.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.lags import DoubleArray, LagTask, anchors, future, origins
from edp.data.series import Series
from edp.storage.memory import check_setting

BLOCK_ROWS = 8_192
"""Rows of lagged inputs held in double precision at a time."""


@dataclass(frozen=True, eq=False)
class Standard:
    """Training means and deviations that keep the sums well scaled.

    Attributes:
        centre: input means ``(input,)``.
        scale: input deviations ``(input,)``; one for an input that does not vary.
        means: target means ``(target,)``, the anchors of targets without a present value.
    """

    centre: DoubleArray
    scale: DoubleArray
    means: DoubleArray


@dataclass(frozen=True, eq=False)
class RidgeMoments:
    """Sums over all rows of standardised lagged inputs x and changes y (future minus anchor, SI units).

    Attributes:
        rows: number of rows.
        x: sum of x, ``(lag * input,)``, lag-major.
        y: sum of y, ``(output,)``.
        xx: sum of x x', ``(lag * input, lag * input)``.
        xy: sum of x y', ``(lag * input, output)``.
        yy: sum of squares of y, ``(output,)``.
    """

    rows: int
    x: DoubleArray
    y: DoubleArray
    xx: DoubleArray
    xy: DoubleArray
    yy: DoubleArray


def standard_of(train: Sequence[Series], means: DoubleArray) -> Standard:
    """Return the means and deviations of the inputs over all training ticks, block by block in double precision."""
    rows = sum(series.samples for series in train)
    centre = sum(block.sum(axis=0) for block in _blocks(train)) / rows
    variance = sum(((block - centre) ** 2).sum(axis=0) for block in _blocks(train)) / rows
    scale = np.sqrt(variance)
    # Below the resolution of float32 the variation is rounding, and dividing by it would amplify it.
    still = scale <= 1e-7 * np.maximum(np.abs(centre), 1e-30)
    return Standard(np.asarray(centre), np.where(still, 1.0, scale), means)


def moments_of(series: Sequence[Series], task: LagTask, standard: Standard) -> RidgeMoments:
    """Return the moments over all ticks with a full history and a known future (see `origins`).

    For ``task.history`` lags.
    """
    lags, inputs = task.history, len(standard.centre)
    check_setting(
        4 * 8 * (lags * inputs) ** 2,  # the matrix, its corrections and two halves, as doubles
        f"a regression on {lags:,} ticks of {inputs:,} inputs",
        "take fewer taps of linear_bypass or a shorter evaluation.history, or fewer channels",
    )
    first = np.zeros((lags, inputs + task.outputs, inputs))
    edges = np.zeros(((lags - 1) * inputs, (lags - 1) * inputs))
    x, y, yy = np.zeros((lags, inputs)), np.zeros(task.outputs), np.zeros(task.outputs)
    rows = 0
    for one in series:
        ticks = origins(one, task)
        for start in range(ticks.start, ticks.stop, BLOCK_ROWS):
            stop = min(start + BLOCK_ROWS, ticks.stop)
            lagged = (one.inputs[start - lags + 1 : stop] - standard.centre) / standard.scale
            change = _changes(one, task, standard, np.arange(start, stop))
            left = np.concatenate([lagged[lags - 1 :], change], axis=1).T
            for lag in range(lags):
                right = lagged[lags - 1 - lag : len(lagged) - lag]
                first[lag] += left @ right
                x[lag] += right.sum(axis=0)
            y += change.sum(axis=0)
            yy += (change**2).sum(axis=0)
            rows += stop - start
        if len(ticks) and lags > 1:
            head = _reverse_rows(one, standard, ticks.start - 1, lags - 1)
            tail = _reverse_rows(one, standard, ticks.stop - 1, lags - 1)
            # One tick earlier the sum gains the row before the first and loses the last one.
            edges += np.outer(head, head) - np.outer(tail, tail)
    gram = _gram(first[:, :inputs, :], edges)
    xy = first[:, inputs:, :].transpose(0, 2, 1).reshape(lags * inputs, task.outputs)
    return RidgeMoments(rows, x.ravel(), y, gram, xy, yy)


def _blocks(train: Sequence[Series]) -> Iterator[DoubleArray]:
    for series in train:
        for start in range(0, series.samples, BLOCK_ROWS):
            yield series.inputs[start : start + BLOCK_ROWS].astype(np.float64)


def _changes(series: Series, task: LagTask, standard: Standard, ticks: np.ndarray) -> DoubleArray:
    """Return the future minus anchor at `ticks`, ``(tick, horizon * target)``."""
    start = anchors(series.inputs[ticks], task, standard.means)
    return (future(series, task, ticks) - start[:, None, :]).reshape(len(ticks), task.outputs)


def _reverse_rows(series: Series, standard: Standard, newest: int, count: int) -> DoubleArray:
    """Return the standardised rows newest, newest - 1, ... as one vector ``(count * input,)``."""
    rows = series.inputs[newest - count + 1 : newest + 1][::-1]
    return ((rows - standard.centre) / standard.scale).ravel()


def _gram(first: DoubleArray, edges: DoubleArray) -> DoubleArray:
    """Complete the Gram matrix from its first block row ``(lag, input, input)`` and the edge corrections."""
    lags, inputs, _ = first.shape
    gram = np.zeros((lags, inputs, lags, inputs))
    correction = edges.reshape(lags - 1, inputs, lags - 1, inputs)
    gram[0] = first.transpose(1, 0, 2)
    for lag in range(1, lags):
        gram[lag, :, lag:] = gram[lag - 1, :, lag - 1 : lags - 1] + correction[lag - 1, :, lag - 1 :]
    square = gram.reshape(lags * inputs, lags * inputs)
    # Diagonal blocks are complete; blocks below them mirror those above.
    # Exactly symmetric, which sums in another order are not.
    upper = np.triu(square)
    return upper + np.triu(square, 1).T
