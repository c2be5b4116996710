"""Boosted regression trees as learners of an ensemble, for steps and switches that smooth learners miss.

Up to three models with as many trees each: one of what the linear model leaves, and two of the targets themselves,
which do not run away with the linear model where the machine goes beyond what was recorded. The first of these reads
only present values and changes over powers of two ticks, as the baseline does, the second all columns. How many trees,
left-out rows say; the trees of the network are then grown on all rows. Trees may leave out several neighbouring folds
at a time: how well trees on fewer rows predict says enough about how many of them to take and how to weigh them, and
costs less.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from edp.data.folds import Folds
from edp.data.lags import DoubleArray
from edp.networks.lag_bank import LagBank
from edp.networks.trees import Trees
from edp.training.bagging.learner import FoldFit, HeadPart
from edp.training.bagging.table import committee_of
from edp.training.outcome import TrainingProgress
from edp.training.tree_tables import Tables, complete_tables, stack_tables

GRID = 2.0**-12
"""Of the columns that trees are grown on, in spreads. Values that are equal but for rounding fall together, so that no
threshold comes to lie between them, where single precision on another machine could go to the other side."""

PENALTY = 1.0
"""Rows of zero that each leaf counts in addition to its own, as in the baseline; its effect alone was not measured."""


@dataclass(frozen=True, eq=False)
class _Boosted:
    """One model of one output.

    Attributes:
        count: trees with the least error on left-out rows; 0 where all of them raise it.
        left_out: predictions of rows by trees that did not see them, ``(row,)``.
        tables: trees grown on all rows; None without trees.
    """

    count: int
    left_out: DoubleArray
    tables: Tables | None


@dataclass(frozen=True, eq=False)
class _Kind:
    """Target and columns of the trees of a model.

    Attributes:
        direct: the targets themselves, or what the linear model leaves of them.
        columns: columns that the trees read, ``(column,)``.
    """

    direct: bool
    columns: NDArray[np.int64]


class TreeLearner:
    """Fits the trees of a committee: to residuals, to the targets by few columns, and to the targets by all columns."""

    def __init__(self, work: FoldFit, trees: Trees) -> None:
        self.work, self.trees = work, trees
        models = min(work.bagging.tree_models, trees.trees)
        self.kinds = _kinds(committee_of(work.net).bank)[:models]
        self.rounds = trees.trees // models
        self.models: list[list[_Boosted]] = []
        rng = np.random.default_rng(work.spec.seed)
        most, folds = work.bagging.tree_max_rows, work.table.folds
        self.parts = [
            (part, _sample(_find_common_rows(folds, part), most, rng))
            for part in np.array_split(np.arange(folds.count), min(work.bagging.tree_folds, folds.count))
        ]
        self.every = _sample(np.arange(len(work.table.columns)), most, rng)

    def fit(self) -> None:
        """Fit every output of all models, with progress after each output."""
        began, outputs = time.perf_counter(), self.work.table.targets.shape[1]
        total = len(self.kinds) * outputs
        for number, kind in enumerate(self.kinds):
            self.models.append([])
            for output in range(outputs):
                self.models[-1].append(self._boost(kind, output))
                done, seconds = number * outputs + output + 1, time.perf_counter() - began
                rate = done * len(self.every) / max(seconds, 1e-9)
                self.work.tell(TrainingProgress(1, 1, done, total, rate, (total - done) * seconds / done))

    def _boost(self, kind: _Kind, output: int) -> _Boosted:
        table = self.work.table
        # Single precision: a hundred predictions of every row are the most that this takes.
        staged = np.zeros((self.rounds, len(table.columns)), dtype=np.float32)
        squared, truth = np.zeros(self.rounds), np.zeros(len(table.columns))
        for part, rows in self.parts:
            for fold in part.tolist():
                # What is left of a row is judged by the line that did not see it, whichever line the trees start from.
                own = table.folds.left_out(fold)
                truth[own] = self._target(own, fold, kind.direct)[:, output]
            judged = np.flatnonzero(np.isin(table.folds.owner, part))
            target = self._target(rows, int(part[0]), kind.direct)[:, output]
            stages = self._grow_trees(rows, target, kind.columns, judged)
            for number, predicted in enumerate(stages):
                staged[number, judged] = predicted
                squared[number] += np.square(predicted - truth[judged]).sum()
        count = int(squared.argmin()) + 1
        if squared[count - 1] >= np.square(truth).sum():
            return _Boosted(0, np.zeros(len(truth)), None)
        target = self._target(self.every, None, kind.direct)[:, output]
        model = self._regressor(count).fit(self._round_to_grid(self.every, kind.columns), target)
        feature, threshold, leaf = complete_tables(model, self.trees.depth)
        return _Boosted(count, staged[count - 1].astype(np.float64), (kind.columns[feature], threshold, leaf))

    def _round_to_grid(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return columns of some rows, rounded to `GRID`."""
        part = self.work.table.columns[rows][:, columns]
        return np.asarray(np.round(part / np.float32(GRID)) * np.float32(GRID))

    def _target(self, rows: NDArray[np.int64], fold: int | None, direct: bool) -> DoubleArray:
        """Return the target of the trees of a fold, or of the trees on all rows, ``(row, output)``."""
        targets = self.work.table.targets[rows]
        if direct:
            return targets
        if fold is not None:
            return self.work.residuals(rows, fold)
        weight, intercept = self.work.linear.mean()
        return np.asarray(targets - self.work.table.columns[rows] @ weight - intercept)

    def _grow_trees(
        self, rows: NDArray[np.int64], target: DoubleArray, columns: NDArray[np.int64], judged: NDArray[np.int64]
    ) -> Iterator[DoubleArray]:
        """Yield the predictions of the evaluation rows after each tree."""
        model = self._regressor(self.rounds).fit(self._round_to_grid(rows, columns), target)
        return iter(model.staged_predict(self.work.table.columns[judged][:, columns]))

    def _regressor(self, rounds: int):  # type: ignore[no-untyped-def]  # scikit-learn has no types
        # Imported here: it takes over a second, and trainings without trees do not need it.
        from sklearn.ensemble import HistGradientBoostingRegressor

        bagging = self.work.bagging
        return HistGradientBoostingRegressor(
            max_iter=rounds,
            max_depth=self.trees.depth,
            max_leaf_nodes=bagging.tree_max_leaves or None,
            learning_rate=bagging.tree_learning_rate,
            min_samples_leaf=bagging.tree_min_leaf_rows,
            l2_regularization=PENALTY,
            early_stopping=False,
            random_state=self.work.spec.seed,
        )

    def left_out(self) -> Sequence[DoubleArray]:
        """Return all models' predictions; direct models are reduced by the linear prediction that they replace."""
        every = [np.stack([model.left_out for model in models], axis=1) for models in self.models]
        linear = self.work.linear.left_out
        return [one - linear if kind.direct else one for kind, one in zip(self.kinds, every, strict=True)]

    def write(self, shares: DoubleArray) -> HeadPart:
        """Write the weighted trees to the network, whose head adds their sums."""
        outputs = self.work.table.targets.shape[1]
        tables = [
            [
                _scale_trees(models[output].tables, share[output])
                for models, share in zip(self.models, shares, strict=True)
            ]
            for output in range(outputs)
        ]
        grown = [[one for one in each if one is not None] for each in tables]
        empty = self._empty()
        joined = [tuple(np.concatenate(part) for part in zip(*each, strict=True)) if each else empty for each in grown]
        self.trees.set_tables(*stack_tables(joined, self.trees.trees))  # type: ignore[arg-type]
        taken_away = sum((own for kind, own in zip(self.kinds, shares, strict=True) if kind.direct), np.zeros(outputs))
        return HeadPart(np.eye(outputs), np.zeros(outputs), np.asarray(taken_away))

    def _empty(self) -> Tables:
        nodes = 2**self.trees.depth - 1
        return (
            np.zeros((0, nodes), dtype=np.int64),
            np.zeros((0, nodes), dtype=np.float32),
            np.zeros((0, nodes + 1), dtype=np.float32),
        )


def _kinds(bank: LagBank) -> list[_Kind]:
    """Return the models; the last one is omitted if it would read all columns."""
    powers = [0, *(span for span, lag in enumerate(bank.lags, start=1) if lag & (lag - 1) == 0)]
    sparse = (np.array(powers)[:, None] * bank.width + np.arange(bank.width)).ravel()
    every = np.arange(bank.columns)
    kinds = [_Kind(False, every), _Kind(True, sparse), _Kind(True, every)]
    return kinds if len(sparse) < len(every) else kinds[:2]


def _find_common_rows(folds: Folds, part: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the training rows common to all folds of a part."""
    return reduce(np.intersect1d, [folds.training[fold] for fold in part.tolist()])


def _scale_trees(tables: Tables | None, share: float) -> Tables | None:
    """Return tables with leaves multiplied by a weight; None for zero weight."""
    if tables is None or share <= 0:
        return None
    feature, threshold, leaf = tables
    return feature, threshold, (leaf * share).astype(np.float32)


def _sample(rows: NDArray[np.int64], most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return at most `most` random rows, in order."""
    return rows if len(rows) <= most else np.sort(rng.choice(rows, most, replace=False))
