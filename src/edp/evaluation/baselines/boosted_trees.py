"""Gradient-boosted regression trees on lag features."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from edp.data.lags import DoubleArray, target_means
from edp.data.series import Series
from edp.evaluation.baselines.base import BASELINES, Baseline, BaselineTask
from edp.evaluation.baselines.lags import LagTable, predict_from_lags, sample_table
from edp.recording import FloatArray

if TYPE_CHECKING:  # scikit-learn takes 1.7 s to import, which every process that never fits a baseline would pay
    from sklearn.ensemble import HistGradientBoostingRegressor

VALIDATION_ROWS = 20_000


@BASELINES.register("boosted_trees")
class BoostedTrees(Baseline):
    """One histogram-based boosted ensemble per horizon and target, predicting the change from the present value.

    The number of trees is the one with the least squared error on validation; without validation all are used.

    Args:
        task: channels to read and to predict.
        row_cap: training rows, drawn with the task's seed.
        trees: largest number of trees per ensemble.
    """

    label = "Boosted trees"

    def __init__(self, task: BaselineTask, row_cap: int = 60_000, trees: int = 150) -> None:
        super().__init__(task)
        self._row_cap = row_cap
        self._trees = trees

    def _fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        self._means = target_means(train)
        table = sample_table(train, self.task, self._means, self._row_cap)
        held_out = sample_table(validation, self.task, self._means, VALIDATION_ROWS)
        self._models = [self._grow(table, held_out, output) for output in range(self.task.outputs)]

    def _grow(self, table: LagTable, held_out: LagTable, output: int) -> tuple[HistGradientBoostingRegressor, int]:
        """Return one ensemble and the number of its trees to use."""
        from sklearn.ensemble import HistGradientBoostingRegressor

        model = HistGradientBoostingRegressor(
            # A common setting of boosted trees; the number of trees alone is chosen, on validation.
            learning_rate=0.1,
            max_iter=self._trees,
            max_leaf_nodes=31,
            l2_regularization=1.0,
            # Early stopping of the library splits off random rows, which lie between training rows of the same drive.
            early_stopping=False,
            random_state=self.task.seed,
        )
        model.fit(table.features, table.changes[:, output])
        if not held_out.rows:
            return model, model.n_iter_
        truth = held_out.changes[:, output]
        # One growth gives the error after every tree; the best number of them costs no further fit.
        losses = [np.mean((stage - truth) ** 2) for stage in model.staged_predict(held_out.features)]
        return model, int(np.argmin(losses)) + 1

    def _predict(self, inputs: FloatArray) -> DoubleArray:
        return predict_from_lags(inputs, self.task, self._means, self._change)

    def _change(self, features: FloatArray) -> DoubleArray:
        columns = []
        for model, trees in self._models:
            change = np.zeros(len(features))
            # `staged_predict` gives sums up to a tree; the last one taken is the prediction.
            for stage in islice(model.staged_predict(features), trees):
                change = stage
            columns.append(change)
        return np.stack(columns, axis=1)
