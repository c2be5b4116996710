"""Persistence: the future is the present."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.data.lags import DoubleArray, anchors, target_means
from edp.data.series import Series
from edp.evaluation.baselines.base import BASELINES, Baseline
from edp.recording import FloatArray


@BASELINES.register("persistence")
class Persistence(Baseline):
    """Holds the present value over all horizons; a target that no input measures gets its training mean."""

    label = "Persistence"
    effort = 0

    def _fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        self._means = target_means(train)

    def _predict(self, inputs: FloatArray) -> DoubleArray:
        last_values = anchors(inputs[self.task.history - 1 :], self.task, self._means)
        return np.repeat(last_values[:, None, :], len(self.task.horizons), axis=1)
