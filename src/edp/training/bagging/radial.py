"""Ridge regression on radial basis functions: the quickest learner of curves where rows are few.

Centres are rows drawn at random; the length and the penalty are those with the least error on rows that were left out.
The penalty is that of kernel ridge regression with the Gaussian kernel on the centres (Nystroem method: Williams and
Seeger, 2001), which the basis functions resemble.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from edp.data.fold_ridge import FoldRidge, fold_ridge
from edp.data.lags import DoubleArray
from edp.networks.radial import RadialFeatures
from edp.training.bagging.learner import FoldFit, HeadPart

LENGTHS = (4.0, 2.0, 1.0, 0.5)
"""Of the basis functions, in roots of the number of columns (the distance of rows of unit spread); smoothest first."""
RANK = 1e-6
"""Directions of the centres' kernel below this share of the largest one would need weights that cancel one another
beyond single precision."""
TINY = 1e-12
JUDGED_ROWS = 40_000
"""Rows that the length is chosen on, evenly spread over longer recordings: an error known within one in a hundred. The
penalty is chosen, and the weights are fitted, on all rows."""
PIECE = 16_384
"""Rows whose distances are computed together."""


@dataclass(frozen=True, eq=False)
class _Kernel:
    """A fit with one length.

    Attributes:
        scale: scale of each column, length times standard deviation, ``(column,)``.
        basis: map from basis functions to directions of unit norm of the Gaussian kernel, ``(centre, direction)``.
        ridge: the folds' ridge regressions on the directions.
    """

    scale: DoubleArray
    basis: DoubleArray
    ridge: FoldRidge


class RadialLearner:
    """Fits the radial basis functions of a committee to what its linear model leaves."""

    def __init__(self, work: FoldFit, features: RadialFeatures) -> None:
        self.work, self.features = work, features
        self.few = features.clipped
        columns = work.table.columns
        # A view where all columns are read: a copy of them would double the memory of the table.
        self.columns = columns[:, features.columns] if self.few else columns
        count = min(features.count, len(columns))
        chosen = np.random.default_rng(work.spec.seed).choice(len(columns), count, replace=False)
        self.centres = self.columns[np.sort(chosen)].astype(np.float64)
        spread = self.columns.std(axis=0, dtype=np.float64)
        self.spread = np.where(spread > 0, spread, 1.0)
        self.best: _Kernel | None = None

    def fit(self) -> None:
        """Choose the length scale and penalty on some rows, then fit on all rows."""
        table, truth = self.work.table, self.work.residual
        every = np.arange(len(table.columns))
        targets = np.stack([self.work.residuals(every, fold) for fold in range(table.folds.count)])
        stride, least, best = max(1, math.ceil(len(every) / JUDGED_ROWS)), np.inf, LENGTHS[0]
        for length in LENGTHS:
            kernel = self._kernel(length, targets[:, ::stride], stride)
            rest = truth[::stride]
            error = np.square(kernel.ridge.left_out - rest).mean(axis=0) / np.maximum(
                np.square(rest).mean(axis=0), TINY
            )
            score = float(np.log(np.maximum(error, TINY)).mean())
            if score < least:
                least, best, self.best = score, length, kernel
        if stride > 1:
            self.best = self._kernel(best, targets, 1)

    def _kernel(self, length: float, targets: DoubleArray, stride: int) -> _Kernel:
        """Fit on every `stride`-th row; targets are given per fold, ``(fold, row, output)``."""
        columns, folds = self.columns[::stride], self.work.table.folds
        scale = length * np.sqrt(columns.shape[1]) * self.spread
        centres = self.centres / scale
        values, vectors = np.linalg.eigh(np.exp(_arguments(centres, centres)))
        within_rank = values > RANK * values[-1]
        basis = vectors[:, within_rank] / np.sqrt(values[within_rank])
        rows = np.empty((len(columns), basis.shape[1]))
        for start in range(0, len(rows), PIECE):
            part = columns[start : start + PIECE] / scale
            rows[start : start + PIECE] = expit(_arguments(part, centres)) @ basis
        thinned = folds if stride == 1 else folds.thinned(stride)
        return _Kernel(scale, basis, fold_ridge(rows, targets, thinned, [np.arange(rows.shape[1])]))

    def left_out(self) -> Sequence[DoubleArray]:
        """Return the predictions of the single model."""
        return [self._require_fit().ridge.left_out]

    def write(self, shares: DoubleArray) -> HeadPart:
        """Return the centres and length into the network; the mean of the folds' models into the head."""
        kernel = self._require_fit()
        weight, intercept = kernel.ridge.mean()
        full = np.zeros((self.features.count, weight.shape[1]))
        full[: len(self.centres)] = kernel.basis @ weight * shares[0]
        centres = torch.zeros(self.features.count, len(kernel.scale))
        centres[: len(self.centres)] = torch.from_numpy(self.centres / kernel.scale)
        with torch.no_grad():
            self.features.gain.copy_(torch.from_numpy(1.0 / kernel.scale))
        self.features.set_centres(centres)
        if self.few:
            limits = (self.columns.min(axis=0), self.columns.max(axis=0))
            self.features.set_limits(*(torch.from_numpy(limit) for limit in limits))
        return HeadPart(full, intercept * shares[0], np.zeros(len(intercept)))

    def _require_fit(self) -> _Kernel:
        if self.best is None:
            raise RuntimeError("the radial learner was asked for its predictions before it was fitted")
        return self.best


def _arguments(rows: NDArray[np.floating], centres: DoubleArray) -> DoubleArray:
    """Return ``-|row - centre|^2 / 2``, ``(row, centre)``."""
    distance = np.square(rows).sum(axis=1)[:, None] + np.square(centres).sum(axis=1) - 2.0 * rows @ centres.T
    return np.asarray(-0.5 * np.maximum(distance, 0.0))
