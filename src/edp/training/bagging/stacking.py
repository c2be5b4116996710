"""Weights of a committee's learners: non-negative least squares on rows that each learner had left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.lags import DoubleArray

MIN_GAIN = 0.01
"""Share by which further learners must lower the error, else they get no weight: on a machine that idles nine tenths of
the time, basis functions on few columns lowered it by less, and had more error on the test recording."""

MIN_FOLD = 1e-4
"""Share of the mean square of the liveliest fold that any fold counts with at least: a hundredth of its deviation."""


def stacking_weights(
    models: Sequence[DoubleArray], residual: DoubleArray, owner: NDArray[np.int64], further: Sequence[bool]
) -> DoubleArray:
    """Return the non-negative weight of each model in the sum, ``(model, output)``.

    Whether an output has further models is evaluated by weights that left out one more fold: all folds' weights have
    seen the rows that they would be evaluated by.

    Args:
        models: addition of each model to the linear prediction of left-out rows, ``(row, output)`` each.
        residual: sum that the additions should reach, ``(row, output)``.
        owner: the fold that left out each row, ``(row,)``.
        further: models that are used only if they reduce the error.
    """
    shares = np.zeros((len(models), residual.shape[1]))
    usual = np.flatnonzero(~np.asarray(further, dtype=bool))
    for output in range(residual.shape[1] if models else 0):
        columns, truth = np.stack([model[:, output] for model in models], axis=1), residual[:, output]
        chosen = np.arange(len(models))
        if len(usual) < len(models):
            least = _compute_nested_error(columns[:, usual], truth, owner)
            if not _compute_nested_error(columns, truth, owner) < (1.0 - MIN_GAIN) * least:
                chosen = usual
        shares[chosen, output] = _weights(columns[:, chosen], truth, owner)
    return shares


def _weights(columns: DoubleArray, truth: DoubleArray, owner: NDArray[np.int64]) -> DoubleArray:
    """Return the non-negative least squares.

    In which a fold counts by the root of the mean square that its best model leaves.

    With squares alone the fold with the liveliest motion would choose. Over eight sets of recordings weights that did
    not see the fold they are evaluated by have 0.8 % less error this way, 2 % less in the mean over folds.
    """
    # Here, since every command that trains imports this module, and scipy.optimize takes a second.
    from scipy.optimize import nnls

    if not columns.shape[1]:
        return np.zeros(0)
    folds, number = np.unique(owner, return_inverse=True)
    left = np.array(
        [np.square(truth[number == k, None] - columns[number == k]).mean(axis=0).min() for k in range(len(folds))]
    )
    # A fold that hardly moves must not rule instead.
    left = np.maximum(left, MIN_FOLD * left.max())
    by_row = left[number] ** -0.25 if left.max() > 0.0 else np.ones(len(truth))
    # Non-negative: a model that only fits the noise gets nothing, and none is played off against another.
    return np.asarray(nnls(columns * by_row[:, None], truth * by_row)[0])


def _compute_nested_error(columns: DoubleArray, truth: DoubleArray, owner: NDArray[np.int64]) -> float:
    """Return the root-mean-square error with weights fitted without the evaluated fold."""
    squared = 0.0
    for fold in np.unique(owner):
        own = owner == fold
        weights = _weights(columns[~own], truth[~own], owner[~own])
        squared += float(np.square(columns[own] @ weights - truth[own]).sum())
    return float(np.sqrt(squared / len(truth)))
