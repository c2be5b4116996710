"""Conditional expectation of channels given the others, present and past: one ridge regression for any groups."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.cluster import hierarchy

Array = NDArray[np.float64]
KNEES = (0.5, 0.7, 0.8, 0.9, 0.96)
"""Quantiles at which each channel has a hinge, so that laws with a dead zone or a threshold can be represented."""
RIDGE = 1e-6
"""Ridge penalty relative to the mean square of a term."""
BLOCK = 8192


@dataclass(frozen=True, eq=False)
class OthersModel:
    """Sums that settle the regression of any channels on all others.

    The terms of a channel are its values at the lags and its hinges ``max(x - knee, 0)`` at the present tick, all
    centred and brought to deviation 1.

    Attributes:
        lags: lags in samples, including 0.
        knees: shape ``(knee, channel)``.
        mean, deviation: mean and standard deviation of the terms, shape ``(term,)``.
        gram: sums of products of the terms over rows, shape ``(term, term)``, over the count.
        owner: channel of each term, shape ``(term,)``.
    """

    lags: tuple[int, ...]
    knees: Array
    mean: Array
    deviation: Array
    gram: Array
    owner: NDArray[np.int64]

    @staticmethod
    def fit(parts: Sequence[NDArray[np.float32]], lags: Sequence[int], rows: int) -> OthersModel:
        """Fit to segments of inputs, each ``(time, channel)``, thinned evenly to about `rows` rows."""
        total = sum(len(part) for part in parts)
        # Neighbouring rows of a 100 Hz log are nearly equal; thinning costs no information.
        every = max(1, total // rows)
        channels = parts[0].shape[1]
        thinned = np.concatenate([part[::every] for part in parts])
        knees = np.quantile(thinned, KNEES, axis=0).astype(np.float64)
        count, sums, products = 0, 0.0, 0.0
        # A floor for channels that never move, which would divide by zero.
        size = np.maximum(thinned.std(axis=0, dtype=np.float64), 1e-30)
        shift = thinned.mean(axis=0, dtype=np.float64)
        pick = np.tile(np.arange(channels), len(lags) + len(KNEES))
        for part in parts:
            terms = _terms(part, lags, knees, np.arange(0, len(part), every))
            # Near 0 and 1 first, so that sums of squares lose no digits.
            terms = (terms - shift[pick]) / size[pick]
            count, sums, products = count + len(terms), sums + terms.sum(axis=0), products + terms.T @ terms
        mean = np.asarray(sums / count)
        # The covariance from sums: rows are read once, whatever the number of groups.
        gram = np.asarray(products / count) - np.outer(mean, mean)
        # Rounding can make the variance of a constant slightly negative.
        spread = np.sqrt(np.maximum(np.diag(gram), 0.0))
        # A term that never moves has no say and no surprise.
        flat = spread < 1e-9
        spread[flat] = 1.0
        gram = gram / np.outer(spread, spread)
        gram[flat, :] = gram[:, flat] = 0.0
        return OthersModel(
            tuple(lags), knees, shift[pick] + size[pick] * mean, size[pick] * spread, gram, pick.astype(np.int64)
        )

    def expect(
        self, groups: Sequence[Sequence[int]], parts: Sequence[NDArray[np.float32]]
    ) -> tuple[list[list[NDArray[np.float32]]], list[float]]:
        """Return the expectation of each group's members given the other channels, and the explained variance fraction.

        Args:
            groups: channels that are estimated together, none of them from another of them.
            parts: inputs, each ``(time, channel)``.

        Returns:
            For each group and part ``(time, member)``; and for each group the share of variance on the rows of the
            fit, mean over its members.
        """
        settled = [self._weights(group) for group in groups]
        weights = np.concatenate([group_weights for group_weights, _ in settled], axis=1)
        members = [self._present(column) for group in groups for column in group]
        expected: list[NDArray[np.float32]] = []
        for part in parts:
            values = np.empty((len(part), len(members)), np.float32)
            for start in range(0, len(part), BLOCK):
                rows = np.arange(start, min(start + BLOCK, len(part)))
                terms = (_terms(part, self.lags, self.knees, rows) - self.mean) / self.deviation
                values[rows] = self.mean[members] + self.deviation[members] * (terms @ weights)
            expected.append(values)
        edges = np.cumsum([0, *(len(group) for group in groups)])
        spans = [slice(a, b) for a, b in itertools.pairwise(edges)]
        return [[values[:, span] for values in expected] for span in spans], [share for _, share in settled]

    def _weights(self, group: Sequence[int]) -> tuple[Array, float]:
        """Return weights, shape ``(term, member)``, zero for the group itself; and the explained variance fraction."""
        members = np.array([self._present(column) for column in group])
        weights = np.zeros((len(self.owner), len(group)))
        outside_terms = np.flatnonzero(~np.isin(self.owner, group))
        if len(outside_terms) == 0:
            return weights, 0.0
        inner, cross = self.gram[np.ix_(outside_terms, outside_terms)], self.gram[np.ix_(outside_terms, members)]
        # The penalty grows with the number of terms, so that collinear lags do not explode.
        solution = linalg.solve(inner + RIDGE * len(outside_terms) * np.eye(len(outside_terms)), cross, assume_a="pos")
        weights[outside_terms] = solution
        # Variance explained by these weights, penalty included: 2 w'c - w'Gw and not w'c, which would flatter.
        explained = 2 * np.sum(solution * cross, axis=0) - np.sum(solution * (inner @ solution), axis=0)
        return weights, float(np.clip(explained, 0.0, 1.0).mean())

    def _present(self, column: int) -> int:
        """Return the term that is the channel itself at the present tick."""
        channels = len(self.owner) // (len(self.lags) + len(KNEES))
        return self.lags.index(0) * channels + column


def collinear(parts: Sequence[NDArray[np.float32]], least: float = 0.9, rows: int = 20_000) -> list[list[int]]:
    """Return groups of two or more channels with at least this absolute rank correlation between every pair.

    Args:
        parts: segments, each ``(time, channel)``.
        least: bound.
        rows: about how many rows are looked at, evenly spread.
    """
    every = max(1, sum(len(part) for part in parts) // rows)
    values = np.concatenate([part[::every] for part in parts]).astype(np.float64)
    moving = np.flatnonzero(values.std(axis=0) > 0)
    if len(moving) < 2:
        return []
    from scipy.stats import rankdata  # late: see edp.stats.effects

    ranks = rankdata(values[:, moving], axis=0)
    # Rank correlation: a bent copy is still a copy.
    apart = 1.0 - np.abs(np.corrcoef(ranks, rowvar=False))
    # Complete linkage: every pair of a group is correlated, not a chain of neighbours.
    tree = hierarchy.linkage(np.clip(apart[np.triu_indices(len(moving), 1)], 0.0, None), "complete")
    label = hierarchy.fcluster(tree, 1.0 - least, "distance")
    groups = [moving[label == number].tolist() for number in np.unique(label)]
    return sorted(group for group in groups if len(group) > 1)


def _terms(part: NDArray[np.float32], lags: Sequence[int], knees: Array, rows: NDArray[np.int64]) -> Array:
    """Return the terms at `rows`, shape ``(row, term)``; before the start the first row holds."""
    lagged = [part[np.maximum(rows - lag, 0)].astype(np.float64) for lag in lags]
    hinges = [np.maximum(part[rows].astype(np.float64) - knee, 0.0) for knee in knees]
    return np.concatenate([*lagged, *hinges], axis=1)
