"""Ridge regression on the columns of a table, its penalty and columns chosen by blocked cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.folds import Folds
from edp.data.lags import DoubleArray

PENALTIES = tuple(10.0 ** (half / 2) for half in range(-14, 5))
"""Penalties per row on columns of unit spread, half a decade apart: from almost none to strong."""

LEAST_GAIN = 1e-4
"""A further set of columns or a weaker penalty must lower the squared error by this share; rounding does less."""


@dataclass(frozen=True, eq=False)
class FoldRidge:
    """Linear maps of each fold and of all rows.

    Attributes:
        weights: of each fold, ``(fold, column, output)``.
        intercepts: ``(fold, output)``.
        left_out: predictions of each row by the fold that left it out, ``(row, output)``.
    """

    weights: DoubleArray
    intercepts: DoubleArray
    left_out: DoubleArray

    def mean(self) -> tuple[DoubleArray, DoubleArray]:
        """Weights ``(column, output)`` and intercept ``(output,)`` of the mean of the folds' predictions."""
        return self.weights.mean(axis=0), self.intercepts.mean(axis=0)


def fold_ridge(
    table: NDArray[np.floating], targets: DoubleArray, folds: Folds, column_sets: Sequence[NDArray[np.int64]]
) -> FoldRidge:
    """For each output the columns and the penalty with the least error on rows that were left out.

    Args:
        table: ``(row, column)``, columns of about unit spread.
        targets: ``(row, output)``, or those of each fold, ``(fold, row, output)``.
        folds: who is left out when.
        column_sets: sets of columns to choose from, the simplest first.
    """
    outputs, columns = targets.shape[-1], table.shape[1]
    of_fold = np.broadcast_to(targets, (folds.count, len(table), outputs))
    rows_of = [folds.left_out(fold) for fold in range(folds.count)]
    trained = [_moments(table[rows], own[rows]) for rows, own in zip(folds.training, of_fold, strict=True)]
    judged = [_moments(table[rows], own[rows]) for rows, own in zip(rows_of, of_fold, strict=True)]
    shares = [len(rows) / len(table) for rows in rows_of]
    best = np.full(outputs, np.inf)
    weights = np.zeros((folds.count, columns, outputs))
    intercepts = np.zeros((folds.count, outputs))
    for chosen in column_sets:
        spectra = [np.linalg.eigh(moments.covariance[np.ix_(chosen, chosen)]) for moments in trained]
        for penalty in sorted(PENALTIES, reverse=True):  # the strongest first: a weaker one must earn its place
            loss, solved, shifts = np.zeros(outputs), [], []
            for moments, (values, vectors), others, share in zip(trained, spectra, judged, shares, strict=True):
                # Rounding can leave eigenvalues of a singular matrix just below zero.
                inverse = 1.0 / (np.maximum(values, 0.0) + penalty)
                weight = vectors @ (inverse[:, None] * (vectors.T @ moments.cross[chosen]))
                shift = moments.level - moments.mean[chosen] @ weight
                solved.append(weight)
                shifts.append(shift)
                loss += share * others.squared_error(chosen, weight, shift)
            better = loss < best * (1.0 - LEAST_GAIN)
            if better.any():
                best[better] = loss[better]
                # Columns of the set chosen before must not stay beside those of the new one.
                weights[:, :, better] = 0.0
                weights[np.ix_(np.arange(folds.count), chosen, np.flatnonzero(better))] = np.stack(solved)[:, :, better]
                intercepts[:, better] = np.stack(shifts)[:, better]
    left_out = np.zeros((len(table), outputs))
    for rows, weight, intercept in zip(rows_of, weights, intercepts, strict=True):
        left_out[rows] = table[rows] @ weight + intercept
    return FoldRidge(weights, intercepts, left_out)


@dataclass(frozen=True, eq=False)
class TableMoments:
    """Means and covariances of a table and its targets.

    Attributes:
        covariance: of the columns, ``(column, column)``.
        cross: of columns and targets, ``(column, output)``.
        mean: of the columns; `level` of the targets.
        variance: of the targets.
    """

    covariance: DoubleArray
    cross: DoubleArray
    mean: DoubleArray
    level: DoubleArray
    variance: DoubleArray

    def squared_error(self, chosen: NDArray[np.int64], weight: DoubleArray, shift: DoubleArray) -> DoubleArray:
        """Mean squared error of a linear map of the columns `chosen`, ``(output,)``."""
        bias = self.mean[chosen] @ weight + shift - self.level
        quadratic = (weight * (self.covariance[np.ix_(chosen, chosen)] @ weight)).sum(axis=0)
        return np.asarray(self.variance - 2.0 * (weight * self.cross[chosen]).sum(axis=0) + quadratic + bias**2)


def _moments(table: NDArray[np.floating], targets: DoubleArray) -> TableMoments:
    """Means and covariances, of a block at a time."""
    rows = len(table)
    mean, level = table.mean(axis=0, dtype=np.float64), targets.mean(axis=0)
    covariance, cross = np.zeros((table.shape[1], table.shape[1])), np.zeros((table.shape[1], targets.shape[1]))
    variance = np.zeros(targets.shape[1])
    for start in range(0, rows, 16_384):  # double-precision copies of a block, not of the whole table
        block, centred = table[start : start + 16_384] - mean, targets[start : start + 16_384] - level
        covariance += block.T @ block / rows
        cross += block.T @ centred / rows
        variance += np.square(centred).sum(axis=0) / rows
    return TableMoments(covariance, cross, mean, level, variance)
