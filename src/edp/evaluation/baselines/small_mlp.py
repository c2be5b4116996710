"""A small multi-layer perceptron on lag features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.data.lags import DoubleArray, target_means
from edp.data.series import Series
from edp.evaluation.baselines.base import BASELINES, Baseline, BaselineTask
from edp.evaluation.baselines.lags import LagTable, predict_from_lags, sample_table
from edp.recording import FloatArray

VALIDATION_ROWS = 20_000
BATCH_ROWS = 256


@BASELINES.register("small_mlp")
class SmallMlp(Baseline):
    """Two hidden layers of 64 ReLU units, all horizons and targets at once, predicting the change from the present.

    Trained with Adam; the weights of the best epoch on validation are kept. Without validation it trains for
    `epochs` and keeps the last weights.

    Args:
        task: channels to read and to predict.
        row_cap: training rows, drawn with the task's seed.
        epochs: most passes over these rows.
        patience: epochs without a better validation error after which training stops.
    """

    label = "Small MLP"
    effort = 3

    def __init__(self, task: BaselineTask, row_cap: int = 60_000, epochs: int = 30, patience: int = 5) -> None:
        super().__init__(task)
        self._row_cap = row_cap
        self._epochs = epochs
        self._patience = patience

    def _fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        # Imported here: scikit-learn takes 1.7 s, which every process that never fits a baseline would pay.
        from sklearn.neural_network import MLPRegressor

        self._means = target_means(train)
        table = sample_table(train, self.task, self._means, self._row_cap)
        held_out = sample_table(validation, self.task, self._means, VALIDATION_ROWS)
        self._centre, self._scale = _standard(table.features)
        self._out_centre, self._out_scale = _standard(table.changes)
        self._model = MLPRegressor(
            hidden_layer_sizes=(64, 64),
            batch_size=min(BATCH_ROWS, table.rows),
            learning_rate_init=1e-3,
            alpha=1e-5,
            random_state=self.task.seed,
        )
        self._train(table, held_out)

    def _train(self, table: LagTable, held_out: LagTable) -> None:
        """Train epochs with early stopping on whole held-out series, since random rows would be too optimistic."""
        features = self._standardise(table.features)
        changes = ((table.changes - self._out_centre) / self._out_scale).astype(np.float32)
        # scikit-learn wants a vector when there is one output.
        changes = changes[:, 0] if self.task.outputs == 1 else changes
        best, waited, best_weights = np.inf, 0, None
        for _ in range(self._epochs):
            self._model.partial_fit(features, changes)
            if not held_out.rows:
                continue
            error = (self._change(held_out.features) - held_out.changes) / self._out_scale
            loss = float(np.mean(error**2))
            if loss < best:
                best, waited = loss, 0
                best_weights = [array.copy() for array in (*self._model.coefs_, *self._model.intercepts_)]
                continue
            waited += 1
            # Epochs are noisy; a few without gain end the training.
            if waited >= self._patience:
                break
        if best_weights is not None:
            layers = len(best_weights) // 2
            self._model.coefs_, self._model.intercepts_ = best_weights[:layers], best_weights[layers:]

    def _predict(self, inputs: FloatArray) -> DoubleArray:
        return predict_from_lags(inputs, self.task, self._means, self._change)

    def _change(self, features: FloatArray) -> DoubleArray:
        output = self._model.predict(self._standardise(features)).reshape(len(features), self.task.outputs)
        changes: DoubleArray = output * self._out_scale + self._out_centre
        return changes

    def _standardise(self, features: FloatArray) -> FloatArray:
        # Beyond ten deviations nothing was learned; the clip keeps a spike from becoming an absurd prediction.
        return np.clip((features - self._centre) / self._scale, -10.0, 10.0).astype(np.float32)


def _standard(values: FloatArray | DoubleArray) -> tuple[DoubleArray, DoubleArray]:
    """Return the mean and deviation of each column; a column that does not vary gets deviation one."""
    # Double precision: the mean of pressures of 1e7 Pa in float32 has no digits left for their spread.
    centre = values.mean(axis=0, dtype=np.float64)
    scale = values.std(axis=0, dtype=np.float64)
    # The threshold is relative: rounding alone gives a constant column a spread above zero.
    still = scale <= 1e-7 * np.maximum(np.abs(centre), 1e-30)
    return centre, np.where(still, 1.0, scale)
