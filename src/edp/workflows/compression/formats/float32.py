"""Single precision, as trained."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

from edp.data.series import Series
from edp.evaluation.controller import Estimate
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.workflows.compression.formats.base import FORMATS, Predict


@FORMATS.register("float32")
class Float32:
    """Everything in single precision; gains of weight norm are folded."""

    label: ClassVar[str] = "FP32"
    estimated: ClassVar[str] = "float32"
    rounded: ClassVar[bool] = False

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """All constants of the exported C code."""
        return estimate.parameter_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """The network as it is."""
        return partial(stream_predictions, predictor)
