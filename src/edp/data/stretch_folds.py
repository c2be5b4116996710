"""Blocked cross-validation for models that train on contiguous segments and are evaluated on such."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.data.folds import make_block_folds
from edp.data.series import Series


@dataclass(frozen=True, eq=False)
class StretchFold:
    """One division of segments into training and validation.

    Attributes:
        train: segments to learn from.
        validation: segments that are left out.
    """

    train: list[Series]
    validation: list[Series]


def stretch_folds(series: Sequence[Series], count: int, gap: int, shortest: int, seed: int) -> list[StretchFold]:
    """Divide segments `count` times; each sample is left out in at most one fold (see `make_block_folds`).

    Args:
        series: at least one segment. They are concatenated in random order, because files are often in the order of the
            driving tasks.
        count: number of folds, at least 2.
        gap: number of samples next to a fold that are omitted from training.
        shortest: minimum length of a segment in samples; shorter segments are omitted.
        seed: random seed of the order.

    Raises:
        DataError: too few ticks.
    """
    dealt = [series[i] for i in np.random.default_rng(seed).permutation(len(series))]
    lengths = [part.samples for part in dealt]
    divided = make_block_folds(lengths, count, gap)
    rows = [(divided.training[i], divided.left_out(i)) for i in range(count)]
    sides = [[_stretches(dealt, lengths, side) for side in both] for both in rows]
    return [StretchFold(*([part for part in side if part.samples >= shortest] for side in both)) for both in sides]


def _stretches(series: Sequence[Series], lengths: Sequence[int], rows: NDArray[np.int64]) -> list[Series]:
    """Return the contiguous segments formed by the given rows."""
    first = np.cumsum(lengths) - lengths
    owner = np.searchsorted(first, rows, side="right") - 1
    breaks = np.flatnonzero((np.diff(rows) != 1) | (np.diff(owner) != 0)) + 1
    runs = zip(np.split(rows, breaks), np.split(owner, breaks), strict=True)
    return [_part(series[of[0]], int(run[0] - first[of[0]]), int(run[-1] + 1 - first[of[0]])) for run, of in runs]


def _part(whole: Series, start: int, stop: int) -> Series:
    """Return rows of a segment, named after the recording with its row range, as `prepare` does."""
    if (start, stop) == (0, whole.samples):
        return whole
    name, bracket, rows = whole.name.removesuffix("]").rpartition("[")
    before = rows.partition(":")[0]
    offset = 0
    # A file may be called `log[²:5]`: digits of which int() makes no number.
    if bracket and whole.name.endswith("]") and before.isdecimal():
        offset = int(before)
    else:
        name = whole.name
    taught = None if whole.strategy_columns is None else whole.strategy_columns[start:stop]
    return replace(
        whole,
        name=f"{name}[{offset + start}:{offset + stop}]",
        inputs=whole.inputs[start:stop],
        targets=whole.targets[start:stop],
        strategy_columns=taught,
    )
