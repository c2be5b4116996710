"""Permutation importance of groups of channels for a random forest, on held-out recordings (eq. 2.14).

The forest is scikit-learn's. To permute a group, only those rows are sent down a tree again whose way tests a channel
of the group; for all others the prediction is known. The result is that of predicting everything again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from edp.data.screening.compiled import compiled, spread
from edp.data.screening.result import Array, GroupImportance
from edp.data.screening.spec import ScreeningSpec
from edp.data.screening.table import CandidateTable
from edp.recording import FloatArray

Ints = NDArray[np.int64]
TreeArrays = tuple[Ints, Ints, Ints, Array]
"""Left and right children, tested channel and threshold of each node."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows for training or evaluation.

    Attributes:
        inputs: channels at t, float32 ``(row, channel)``.
        changes: predicted values: target at t + horizon minus target at t (the target itself at horizon 0), scaled to
            deviation 1 over all rows, ``(row, target)``.
        pieces: piece of each row.
    """

    inputs: FloatArray
    changes: Array
    pieces: Ints


def rows_of(table: CandidateTable, pieces: Sequence[int], columns: Ints, count: int, horizon: int) -> Rows:
    """Return evenly spaced rows of some segments.

    Channels have deviation 1, for which float32 splits of trees suffice.
    """
    inputs, changes, places = [], [], []
    total = sum(table.pieces[p].samples for p in pieces)
    for p in pieces:
        for stretch in table.pieces[p].stretches:
            usable = len(stretch) - horizon
            if usable < 1:
                continue
            row_indices = np.linspace(0, usable - 1, max(1, min(usable, count * len(stretch) // total))).astype(
                np.int64
            )
            inputs.append(stretch[row_indices][:, columns])
            ahead = stretch[row_indices + horizon][:, table.targets].astype(np.float64)
            changes.append(ahead - stretch[row_indices][:, table.targets] if horizon else ahead)
            places.append(np.full(len(row_indices), p))
    scaled = (np.concatenate(inputs) - table.mean[columns]) / np.maximum(table.within[columns], 1e-30)
    return Rows(np.ascontiguousarray(scaled, dtype=np.float32), np.concatenate(changes), np.concatenate(places))


@compiled
def _leaves(
    inputs: FloatArray, rows: Ints, swapped: Ints, columns: NDArray[np.bool_], tree: TreeArrays, out: Ints
) -> None:
    """Return the leaf of each of `rows`; channels in `columns` are read from row ``swapped[row]`` instead."""
    left, right, feature, threshold = tree
    for out_index in range(len(rows)):
        row = rows[out_index]
        other = swapped[row]
        node = 0
        # scikit-learn marks leaves by children of -1.
        while left[node] >= 0:
            tested = feature[node]
            value = inputs[other, tested] if columns[tested] else inputs[row, tested]
            node = left[node] if value <= threshold[node] else right[node]
        out[out_index] = node


@compiled
def _marks(inputs: FloatArray, tree: TreeArrays, groups: Ints, out: NDArray[np.int8]) -> None:
    """Mark the groups that are tested on the decision path of each row: ``out[row, group] = 1``."""
    left, right, feature, threshold = tree
    for row in range(len(inputs)):
        node = 0
        while left[node] >= 0:
            tested = feature[node]
            out[row, groups[tested]] = 1
            node = left[node] if inputs[row, tested] <= threshold[node] else right[node]


class Permuted:
    """Errors of a forest with a group of channels permuted.

    Args:
        trees: fitted scikit-learn trees.
        rows: held-out rows.
        groups: number of the group of each channel, ``(channel,)``.
    """

    def __init__(self, trees: Sequence[object], rows: Rows, groups: Ints) -> None:
        self.rows, self.groups = rows, groups
        self.trees = [_arrays(tree) for tree in trees]
        count, identity = len(rows.inputs), np.arange(len(rows.inputs))
        none = np.zeros(rows.inputs.shape[1], dtype=np.bool_)
        self.leaves, self.touched = [], []
        for tree, _ in self.trees:
            leaves, marks = np.empty(count, dtype=np.int64), np.zeros((count, groups.max() + 1), dtype=np.int8)
            _leaves(rows.inputs, identity, identity, none, tree, leaves)
            _marks(rows.inputs, tree, groups, marks)
            self.leaves.append(leaves)
            self.touched.append(marks)
        values = [value[leaves] for (_, value), leaves in zip(self.trees, self.leaves, strict=True)]
        self.predicted = np.sum(values, axis=0)

    def errors(self, group: int | None, order: Ints) -> Array:
        """Return the squared error of each row and target with the columns of `group` read from the rows of `order`."""
        total = self.predicted
        if group is not None:
            total = self.predicted.copy()
            columns = self.groups == group
            for (tree, value), leaves, touched in zip(self.trees, self.leaves, self.touched, strict=True):
                rows = np.flatnonzero(touched[:, group])
                if len(rows):
                    leaf_of_row = np.empty(len(rows), dtype=np.int64)
                    _leaves(self.rows.inputs, rows, order, columns, tree, leaf_of_row)
                    total[rows] += value[leaf_of_row] - value[leaves[rows]]
        return np.asarray(np.square(total / len(self.trees) - self.rows.changes))


def _arrays(tree: object) -> tuple[TreeArrays, Array]:
    """Return the nodes of a fitted tree and the value of each node, ``(node, target)``."""
    inner = tree.tree_  # type: ignore[attr-defined]
    nodes = (
        inner.children_left.astype(np.int64),
        inner.children_right.astype(np.int64),
        inner.feature.astype(np.int64),
        inner.threshold.astype(np.float64),
    )
    return nodes, np.ascontiguousarray(inner.value[:, :, 0])


def importances(
    table: CandidateTable,
    columns: Ints,
    groups: Sequence[Sequence[int]],
    held_out: Ints,
    spec: ScreeningSpec,
    on_share: Callable[[float], None] | None = None,
) -> list[GroupImportance]:
    """Fit a random forest on the training segments and permute each group of channels on the left-out segments.

    Args:
        table: the data.
        columns: indices of the columns that the forest reads.
        groups: places in `columns` that are permuted together.
        held_out: segments held out.
        spec: sizes and seed.
        on_share: hears the share that is done.
    """
    from sklearn.ensemble import RandomForestRegressor

    forest = spec.forest
    others = [p for p in range(len(table.pieces)) if p not in set(held_out.tolist())]
    train = rows_of(table, others, columns, forest.samples, spec.horizon)
    tests = rows_of(table, held_out.tolist(), columns, forest.test_samples, spec.horizon)
    scale = np.maximum(train.changes.std(axis=0), 1e-30)
    train, tests = (Rows(r.inputs, (r.changes - train.changes.mean(axis=0)) / scale, r.pieces) for r in (train, tests))
    model = RandomForestRegressor(
        forest.trees,
        min_samples_leaf=forest.min_samples_leaf,
        max_features=forest.max_features,
        n_jobs=-1,
        random_state=spec.seed,
    )
    # One target goes as a vector, since scikit-learn warns of a single column.
    model.fit(train.inputs, train.changes if train.changes.shape[1] > 1 else train.changes[:, 0])
    if on_share is not None:
        on_share(0.6)
    number = np.zeros(len(columns), dtype=np.int64)
    for g, group in enumerate(groups):
        number[list(group)] = g
    permuted = Permuted(model.estimators_, tests, number)
    plain = permuted.errors(None, np.arange(len(tests.inputs)))
    # The same permutations for every group, so that groups differ by what they are and not by chance.
    orders = [_shuffle_rows(tests.pieces, spec.seed + r) for r in range(forest.repeats)]

    def of_group(g: int) -> Array:
        """Return the mean error increase in each left-out segment, ``(segment, target)``."""
        more = np.mean([permuted.errors(g, order) for order in orders], axis=0) - plain
        return np.stack([more[tests.pieces == p].mean(axis=0) for p in held_out])

    increases = np.stack(spread(of_group, range(len(groups))))
    power = np.stack([np.square(tests.changes[tests.pieces == p]).mean(axis=0) for p in held_out]).mean(axis=0)
    names = [table.names[i] for i in columns]
    return _list_importances(
        increases / power, [[names[k] for k in group] for group in groups], [table.names[i] for i in table.targets]
    )


def _shuffle_rows(pieces: Ints, seed: int) -> Ints:
    """Return a permutation of the rows within each segment, which keeps the distribution of each channel there."""
    rng = np.random.default_rng(seed)
    order = np.arange(len(pieces))
    for piece in np.unique(pieces):
        rows = np.flatnonzero(pieces == piece)
        order[rows] = rng.permutation(rows)
    return order


def _list_importances(
    increases: Array, members: Sequence[Sequence[str]], targets: Sequence[str]
) -> list[GroupImportance]:
    """Return the entries for every group, for each target and for all targets.

    The increases are ``(group, segment, target)``.
    """
    columns = [("all", increases.mean(axis=2)), *((name, increases[:, :, j]) for j, name in enumerate(targets))]
    importances = []
    for name, values in columns:
        middle = values.mean(axis=1)
        positive = max(float(np.maximum(middle, 0.0).sum()), 1e-30)
        # Pieces are the units: rows of one recording depend on one another.
        half = stdtrit(values.shape[1] - 1, 0.975) * values.std(axis=1, ddof=1) / math.sqrt(values.shape[1])
        for g, group in enumerate(members):
            importances.append(
                GroupImportance(
                    tuple(group),
                    name,
                    float(middle[g]),
                    float(middle[g] - half[g]),
                    float(middle[g] + half[g]),
                    max(float(middle[g]), 0.0) / positive,
                )
            )
    return importances
