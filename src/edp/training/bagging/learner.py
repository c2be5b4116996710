"""Learners that an ensemble adds to its linear model, each fitted with every fold left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.fold_ridge import FoldRidge
from edp.data.lags import DoubleArray
from edp.data.prepared import Prepared
from edp.networks.predictor import Predictor
from edp.storage.reading import Table
from edp.training.bagging.spec import BaggingSpec
from edp.training.bagging.table import BaggingTable
from edp.training.outcome import TrainingProgress
from edp.training.spec import TrainingSpec


@dataclass(frozen=True, eq=False)
class FoldFit:
    """A training on folds at work: everything that a learner needs.

    Attributes:
        net: the network; its bank is set, its other parts wait for their numbers.
        data: prepared series.
        spec: settings of the training.
        table: the rows.
        linear: the linear models of the folds.
        tell: called with progress.
        history: a row for each check of the learners that train step by step.
    """

    net: Predictor
    data: Prepared
    spec: TrainingSpec
    table: BaggingTable
    linear: FoldRidge
    tell: Callable[[TrainingProgress], None]
    history: list[Table] = field(default_factory=list)

    @property
    def bagging(self) -> BaggingSpec:
        """The settings of bagging."""
        return self.spec.ensemble or BaggingSpec()

    @property
    def residual(self) -> DoubleArray:
        """Residuals of the linear models on left-out rows, standardised ``(row, output)``."""
        return np.asarray(self.table.targets - self.linear.left_out)

    def residuals(self, rows: NDArray[np.int64], fold: int) -> DoubleArray:
        """Return the residuals of one fold's linear model on some rows, standardised ``(row, output)``."""
        predicted = self.table.columns[rows] @ self.linear.weights[fold] + self.linear.intercepts[fold]
        return np.asarray(self.table.targets[rows] - predicted)


@dataclass(frozen=True, eq=False)
class HeadPart:
    """A learner's part of the linear head.

    Attributes:
        weight: weights of its part of the representation, ``(number, output)``.
        bias: ``(output,)``.
        linear: share of the linear model that it takes away, ``(output,)``: of those that predict without it.
    """

    weight: DoubleArray
    bias: DoubleArray
    linear: DoubleArray


class Learner(Protocol):
    """One kind of learner; its representation elements are in the order of the ensemble's parts."""

    def fit(self) -> None:
        """Learn."""
        ...

    def left_out(self) -> Sequence[DoubleArray]:
        """Return the additions of each model to the linear prediction of left-out rows, ``(row, output)`` each."""
        ...

    def write(self, shares: DoubleArray) -> HeadPart:
        """Write the fitted learner to the network.

        Args:
            shares: non-negative weight of each of its models in the sum, ``(model, output)``.
        """
        ...
