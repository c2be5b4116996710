"""Ridge ARX: a linear map from the last samples of all inputs to each horizon, the strongest linear baseline."""

from __future__ import annotations

from collections.abc import Sequence

from edp.data.lags import DoubleArray
from edp.data.ridge import RidgeSolution, ridge_solution
from edp.data.series import Series
from edp.errors import ConfigError
from edp.evaluation.baselines.base import BASELINES, Baseline
from edp.recording import FloatArray


@BASELINES.register("ridge_arx")
class RidgeArx(Baseline):
    """One ridge map per horizon and target, with penalty and history chosen on the validation part."""

    label = "Ridge ARX"
    effort = 1

    def _fit(self, train: Sequence[Series], validation: Sequence[Series]) -> None:
        self._solution = ridge_solution(train, self.task, validation)

    def _predict(self, inputs: FloatArray) -> DoubleArray:
        return self._solution.predict(inputs)

    @property
    def solution(self) -> RidgeSolution:
        """The fitted map.

        Raises:
            ConfigError: called before `fit`.
        """
        if self._inputs is None:
            raise ConfigError("the ridge baseline has not been fitted; call fit before reading its solution")
        return self._solution

    @property
    def weights(self) -> DoubleArray:
        """Weights in SI units, ``(history, input, horizon, target)``; see `RidgeSolution`."""
        return self.solution.weights

    @property
    def intercept(self) -> DoubleArray:
        """Intercept in SI units, ``(horizon, target)``."""
        return self.solution.intercept
