"""Blocked cross-validation: each fold leaves out contiguous segments, with gaps around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError

FEWEST_ROWS = 20
"""Rows that a fold must have; fewer say nothing about an error."""
FEWEST_RECORDINGS, MIN_TRAINING = 3, 0.3
"""Recordings from which on folds can leave out whole ones, and the share of the rows that each fold keeps for training
then: of two recordings, or where one has nearly all rows, a fold would learn next to nothing of the machine."""


@dataclass(frozen=True, eq=False)
class Folds:
    """Cross-validation folds: the training rows and the left-out rows of each fold.

    Attributes:
        owner: fold that leaves a row out, ``(row,)``.
        training: rows that each fold trains on, one array a fold; rows within the gap are in neither.
    """

    owner: NDArray[np.int64]
    training: tuple[NDArray[np.int64], ...]

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.training)

    def left_out(self, fold: int) -> NDArray[np.int64]:
        """Return the rows on which `fold` is evaluated."""
        return np.flatnonzero(self.owner == fold)

    def thinned(self, stride: int) -> Folds:
        """Return the folds restricted to every `stride`-th row."""
        training = tuple(rows[rows % stride == 0] // stride for rows in self.training)
        return Folds(self.owner[::stride], training)


def make_block_folds(lengths: Sequence[int], folds: int, gap: int, pieces: int = 1) -> Folds:
    """Return folds of nearly equal size over the concatenated segments, each of `pieces` contiguous parts.

    Args:
        lengths: rows of each segment, in order.
        folds: number of folds, 2 or more.
        gap: rows beside a piece, in the same segment, that share history or future with it and do not train.
        pieces: number of contiguous parts per fold. Consecutive parts belong to different folds.

    Raises:
        DataError: too few rows for so many folds, or a fold would have nothing to train on.
    """
    total = int(sum(lengths))
    if total < folds * FEWEST_ROWS:
        raise DataError(
            f"cross-validation: {total} rows for {folds} folds; each fold needs {FEWEST_ROWS}: record longer, or, "
            "where training.ensemble.folds is among your settings, take fewer folds"
        )
    # Contiguous: rows drawn one by one would share history and future with those that are left out.
    piece = np.arange(total) * (folds * pieces) // total
    owner = piece % folds
    ends = np.cumsum(lengths)
    stretch = np.repeat(np.arange(len(lengths)), lengths)
    # The first row of each run of one piece in one stretch, and the one behind its last.
    edges = np.flatnonzero(np.diff(piece) + np.diff(stretch)) + 1
    runs = list(zip([0, *edges.tolist()], [*edges.tolist(), total], strict=True))
    training = []
    for fold in range(folds):
        trains = owner != fold
        for start, stop in runs:
            if owner[start] == fold:
                number = stretch[start]
                first, last = ends[number] - lengths[number], ends[number]
                trains[max(first, start - gap) : min(last, stop + gap)] = False
        training.append(np.flatnonzero(trains))
        if len(training[-1]) < FEWEST_ROWS:
            raise DataError(
                f"cross-validation: fold {fold + 1} of {folds} leaves {len(training[-1])} rows to train on beside a "
                f"gap of {gap}; {FEWEST_ROWS} or more must be left: record at least two independent stretches, each "
                "longer than the largest horizon and the longest lag, or shorten these"
            )
    return Folds(owner, tuple(training))


def recording_folds(lengths: Sequence[int], recordings: Sequence[str], folds: int) -> Folds | None:
    """Return the folds that leave out whole recordings, as many of them as there are recordings at most.

    Each fold takes recordings until it has its share of the rows, the longest first.

    Args:
        lengths: rows of each segment, laid end to end.
        recordings: index of the recording of each segment.
        folds: number of folds at most.

    Returns:
        None where there are fewer than `FEWEST_RECORDINGS`, or one fold would train on less than `MIN_TRAINING`.
    """
    names = list(dict.fromkeys(recordings))
    if len(names) < FEWEST_RECORDINGS:
        return None
    rows = dict.fromkeys(names, 0)
    for name, length in zip(recordings, lengths, strict=True):
        rows[name] += length
    count = min(folds, len(names))
    filled, fold_of = [0] * count, {}
    for name in sorted(names, key=lambda name: -rows[name]):
        fold_of[name] = filled.index(min(filled))
        filled[fold_of[name]] += rows[name]
    if max(filled) > (1.0 - MIN_TRAINING) * sum(filled) or min(filled) < FEWEST_ROWS:
        return None
    owner = np.repeat([fold_of[name] for name in recordings], lengths)
    return Folds(owner, tuple(np.flatnonzero(owner != fold) for fold in range(count)))
