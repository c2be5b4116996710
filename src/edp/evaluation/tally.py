"""Scores of one model at one horizon, taken in part by part: hours of predictions need not lie in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data.moments import Moments, MomentsState
from edp.evaluation.scores_file import MEAN, ByTarget
from edp.stats.metrics import Scores, composite, mean_scores, score
from edp.stats.sketch import MAX_EXACT, QuantileSketch

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SumsState:
    """Sums of all targets: moments of the truth, sums of errors, and sketches of the sizes of errors."""

    truth: MomentsState
    errors: Values
    sizes: tuple[Mapping[str, NDArray[Any]], ...]


@dataclass(frozen=True, eq=False)
class TallyState:
    """Content of a `Tally`: its samples, predicted and true, or sums if there are many."""

    count: int
    samples: tuple[Values, Values] | None = None
    sums: SumsState | None = None


class Tally:
    """Errors of all targets at one horizon.

    Up to `MAX_EXACT` ticks are kept and scored as they are; beyond, sums go on in double precision, and percentiles
    come from bins of a thousandth.

    Args:
        targets: their names.
    """

    def __init__(self, targets: Sequence[str]) -> None:
        self.targets = tuple(targets)
        self.count = 0
        self._kept: list[tuple[Values, Values]] = []
        self._sums: _Sums | None = None

    def update(self, predicted: Values, truth: Values) -> None:
        """Take in ticks, each ``(tick, target)`` in report units."""
        self.count += len(truth)
        self._kept.append((predicted, truth))
        if self.count > MAX_EXACT or self._sums is not None:
            self._sum_all()

    def state(self) -> TallyState:
        """Return the content, for another process."""
        if self._sums is not None:
            return TallyState(self.count, sums=self._sums.state())
        nothing = np.zeros((0, len(self.targets)))
        predicted, truth = (np.concatenate([nothing, *(pair[i] for pair in self._kept)]) for i in range(2))
        return TallyState(self.count, samples=(predicted, truth))

    def add(self, state: TallyState) -> None:
        """Add the content of another one."""
        if state.samples is not None:
            self.update(*state.samples)
        elif state.sums is not None:
            self._sum_all().add(state.sums)
            self.count += state.count

    def _sum_all(self) -> _Sums:
        """Move single samples into the sums and return the sums."""
        self._sums = self._sums or _Sums(len(self.targets))
        for part in self._kept:
            self._sums.update(*part)
        self._kept = []
        return self._sums

    def scores(self) -> ByTarget:
        """Return the scores by target, and their mean."""
        if self._sums is not None:
            return name_scores(self.targets, self._sums.scores())
        predicted, truth = (np.concatenate(side) for side in zip(*self._kept, strict=True))
        return name_scores(self.targets, [score(predicted[:, i], truth[:, i]) for i in range(len(self.targets))])


class _Sums:
    """Sums from which scores are computed, for each target."""

    def __init__(self, targets: int) -> None:
        self.truth = Moments(targets)
        self.errors = np.zeros((3, targets))  # their sum, that of their squares, that of their sizes
        self.sizes = [QuantileSketch() for _ in range(targets)]

    def update(self, predicted: Values, truth: Values) -> None:
        if not len(truth):
            return
        self.truth.update(truth)
        error = predicted - truth
        size = np.abs(error)
        self.errors += np.stack([error.sum(axis=0), np.square(error).sum(axis=0), size.sum(axis=0)])
        for sketch, column in zip(self.sizes, size.T, strict=True):
            sketch.update(column)

    def state(self) -> SumsState:
        return SumsState(self.truth.state(), self.errors, tuple(sketch.state() for sketch in self.sizes))

    def add(self, state: SumsState) -> None:
        self.truth.add(state.truth)
        self.errors += state.errors
        for sketch, size in zip(self.sizes, state.sizes, strict=True):
            sketch.add(size)

    def scores(self) -> list[Scores]:
        count, each = self.truth.count, []
        for i, sketch in enumerate(self.sizes):
            bias, mean_square, mae = (float(total) / count for total in self.errors[:, i])
            p95, p99 = sketch.quantiles((0.95, 0.99))
            moves = self.truth.low[i] < self.truth.high[i] and self.truth.squares[i] > 0
            r2 = 1.0 - mean_square * count / float(self.truth.squares[i]) if moves else None
            rmse = float(np.sqrt(mean_square))
            each.append(Scores(mae, rmse, r2, p95, p99, composite(mae, rmse, p95, p99), bias, count))
        return each


def name_scores(targets: Sequence[str], each: Sequence[Scores]) -> ByTarget:
    """Return the scores of each target by name and their mean, as plain values."""
    named = {MEAN: mean_scores(each), **dict(zip(targets, each, strict=True))}
    return {name: values.to_json() for name, values in named.items()}
