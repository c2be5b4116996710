"""Ridge regression on the columns of a table, its penalty and columns chosen by blocked cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.folds import Folds
from edp.data.lags import DoubleArray

PENALTIES = tuple(10.0 ** (half / 2) for half in range(-14, 5))
"""Ridge penalties per row on columns with unit standard deviation, half a decade apart, from almost zero to strong."""

MIN_GAIN = 1e-4
"""Minimum relative reduction of the squared error that justifies additional columns or a weaker penalty. It is above
rounding errors."""


@dataclass(frozen=True, eq=False)
class FoldRidge:
    """Linear maps of each fold and of all rows.

    Attributes:
        weights: weights of each fold, ``(fold, column, output)``.
        intercepts: ``(fold, output)``.
        left_out: predictions of each row by the fold that left it out, ``(row, output)``.
    """

    weights: DoubleArray
    intercepts: DoubleArray
    left_out: DoubleArray

    def mean(self) -> tuple[DoubleArray, DoubleArray]:
        """Return the weights ``(column, output)`` and intercept ``(output,)`` of the mean of the folds' predictions."""
        return self.weights.mean(axis=0), self.intercepts.mean(axis=0)


def fold_ridge(
    table: NDArray[np.floating], targets: DoubleArray, folds: Folds, column_sets: Sequence[NDArray[np.int64]]
) -> FoldRidge:
    """Return the columns and the penalty with the least error on left-out rows for each output.

    Args:
        table: ``(row, column)``, columns of about unit spread.
        targets: ``(row, output)``, or those of each fold, ``(fold, row, output)``.
        folds: folds of the cross-validation.
        column_sets: sets of columns to choose from, the simplest first.
    """
    outputs, columns = targets.shape[-1], table.shape[1]
    trained, judged = _fold_moments(table, targets, folds)
    shares = np.bincount(folds.owner, minlength=folds.count) / len(table)
    best = np.full(outputs, np.inf)
    weights = np.zeros((folds.count, columns, outputs))
    intercepts = np.zeros((folds.count, outputs))
    for chosen in column_sets:
        spectra = [_Spectrum.from_moments(moments.select_columns(chosen)) for moments in trained]
        others = [moments.select_columns(chosen) for moments in judged]
        for penalty in sorted(PENALTIES, reverse=True):  # the strongest first: a weaker one must earn its place
            solved = [spectrum.solve(penalty) for spectrum in spectra]
            losses = [share * one.squared_error(*maps) for share, one, maps in zip(shares, others, solved, strict=True)]
            loss = np.sum(losses, axis=0)
            better = loss < best * (1.0 - MIN_GAIN)
            if better.any():
                best[better] = loss[better]
                # Columns of the previous set must not remain in the new set.
                weights[:, :, better] = 0.0
                own = np.stack([weight for weight, _ in solved])
                weights[np.ix_(np.arange(folds.count), chosen, np.flatnonzero(better))] = own[:, :, better]
                intercepts[:, better] = np.stack([shift for _, shift in solved])[:, better]
    left_out = np.zeros((len(table), outputs))
    for fold, (weight, intercept) in enumerate(zip(weights, intercepts, strict=True)):
        rows = folds.left_out(fold)
        left_out[rows] = table[rows] @ weight + intercept
    return FoldRidge(weights, intercepts, left_out)


@dataclass(frozen=True, eq=False)
class TableMoments:
    """Means and covariances of a table and its targets.

    Attributes:
        covariance: covariance of the columns, ``(column, column)``.
        cross: covariance of columns and targets, ``(column, output)``.
        mean: mean of the columns; `level` is the mean of the targets.
        variance: variance of the targets.
    """

    covariance: DoubleArray
    cross: DoubleArray
    mean: DoubleArray
    level: DoubleArray
    variance: DoubleArray

    def select_columns(self, chosen: NDArray[np.int64]) -> TableMoments:
        """Return the moments of the selected columns."""
        covariance = self.covariance[np.ix_(chosen, chosen)]
        return TableMoments(covariance, self.cross[chosen], self.mean[chosen], self.level, self.variance)

    def squared_error(self, weight: DoubleArray, shift: DoubleArray) -> DoubleArray:
        """Return the mean squared error of a linear map, ``(output,)``."""
        bias = self.mean @ weight + shift - self.level
        quadratic = (weight * (self.covariance @ weight)).sum(axis=0)
        return np.asarray(self.variance - 2.0 * (weight * self.cross).sum(axis=0) + quadratic + bias**2)


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Ridge regressions of one set of rows, for any penalty.

    Attributes:
        moments: means and covariances of the rows.
        values: eigenvalues of their covariance.
        vectors: its eigenvectors, ``(column, direction)``.
        turned: covariances of directions and targets, ``(direction, output)``.
    """

    moments: TableMoments
    values: DoubleArray
    vectors: DoubleArray
    turned: DoubleArray

    @classmethod
    def from_moments(cls, moments: TableMoments) -> _Spectrum:
        """Return the eigenvalue decomposition for the moments of some rows."""
        values, vectors = np.linalg.eigh(moments.covariance)
        # Rounding can leave eigenvalues of a singular matrix just below zero.
        return cls(moments, np.maximum(values, 0.0), vectors, vectors.T @ moments.cross)

    def solve(self, penalty: float) -> tuple[DoubleArray, DoubleArray]:
        """Return the weights ``(column, output)`` and intercepts ``(output,)``."""
        weight = self.vectors @ (self.turned / (self.values + penalty)[:, None])
        return weight, self.moments.level - self.moments.mean @ weight


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums of products over rows, centred on common values.

    Attributes:
        rows: number of rows.
        squares: products of columns, ``(column, column)``.
        cross: products of columns and targets, ``(column, target)``.
        first: sums of the columns; `level` are sums of the targets, `power` sums of their squares.
    """

    rows: int
    squares: DoubleArray
    cross: DoubleArray
    first: DoubleArray
    level: DoubleArray
    power: DoubleArray

    @classmethod
    def none(cls, columns: int, targets: int) -> _Sums:
        """Return sums over zero rows."""
        shapes = ((columns, columns), (columns, targets), (columns,), (targets,), (targets,))
        return cls(0, *(np.zeros(shape) for shape in shapes))

    def plus(self, other: _Sums, sign: int = 1) -> _Sums:
        """Return the sums over the rows of both, or with ``sign=-1`` the difference."""
        pairs = [(mine, vars(other)[name]) for name, mine in vars(self).items()]
        return _Sums(*(mine + sign * theirs for mine, theirs in pairs))

    def moments(self, centre: DoubleArray, level: DoubleArray, own: slice) -> TableMoments:
        """Return the means and covariances, with some of the targets; sums are about these centres."""
        mean, height = self.first / self.rows, self.level[own] / self.rows
        return TableMoments(
            self.squares / self.rows - np.outer(mean, mean),
            self.cross[:, own] / self.rows - np.outer(mean, height),
            centre + mean,
            level[own] + height,
            self.power[own] / self.rows - np.square(height),
        )


def _fold_moments(
    table: NDArray[np.floating], targets: DoubleArray, folds: Folds
) -> tuple[list[TableMoments], list[TableMoments]]:
    """Return the moments of the rows that each fold trains on, and of those that it leaves out.

    The products of a row are computed once for the fold that leaves the row out, and once for each fold with the row in
    its gap. The training moments of a fold are the sum over the other folds minus its gap.
    """
    outputs = targets.shape[-1]
    centre, level = table.mean(axis=0, dtype=np.float64), targets.mean(axis=-2).ravel()
    judged, gaps = [], []
    for fold, training in enumerate(folds.training):
        rows = folds.left_out(fold)
        beside = np.ones(len(table), dtype=bool)
        beside[rows] = beside[training] = False
        judged.append(_sums(table, targets, rows, centre, level))
        gaps.append(_sums(table, targets, np.flatnonzero(beside), centre, level))
    every = _Sums.none(table.shape[1], len(level))
    for one in judged:
        every = every.plus(one)
    own = [slice(None) if targets.ndim == 2 else slice(f * outputs, (f + 1) * outputs) for f in range(folds.count)]
    trained = [every.plus(one, -1).plus(gap, -1) for one, gap in zip(judged, gaps, strict=True)]
    return (
        [sums.moments(centre, level, part) for sums, part in zip(trained, own, strict=True)],
        [sums.moments(centre, level, part) for sums, part in zip(judged, own, strict=True)],
    )


def _sums(
    table: NDArray[np.floating], targets: DoubleArray, rows: NDArray[np.int64], centre: DoubleArray, level: DoubleArray
) -> _Sums:
    """Return sums over the given rows, computed block by block.

    Targets of several folds are columns of one matrix, so that the table is multiplied once.
    """
    total = _Sums.none(table.shape[1], len(level))
    for start in range(0, len(rows), 8_192):  # double-precision copies of a block, not of the whole table
        own = rows[start : start + 8_192]
        wide = targets[own] if targets.ndim == 2 else targets[:, own].transpose(1, 0, 2).reshape(len(own), -1)
        block, ahead = table[own] - centre, wide - level
        part = _Sums(
            len(own),
            block.T @ block,
            block.T @ ahead,
            block.sum(axis=0),
            ahead.sum(axis=0),
            np.square(ahead).sum(axis=0),
        )
        total = total.plus(part)
    return total
