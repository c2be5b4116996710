"""Ridge ARX on the target: the strongest linear predictor of its logs."""

from __future__ import annotations

from typing import ClassVar

from edp.evaluation.baselines import RidgeArx
from edp.evaluation.judge import baseline_predictions
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made


@METHODS.register("ridge_arx")
class Ridge:
    """A linear map from the last samples of all inputs, fitted on the target's training part."""

    label: ClassVar[str] = "Ridge ARX on the target"
    trains: ClassVar[bool] = False
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Fit it; penalty and history are chosen on the validation part."""
        predict, baseline = baseline_predictions(RidgeArx, case.data, case.experiment.judge)
        return Made(predict, int(baseline.weights.size + baseline.intercept.size))
