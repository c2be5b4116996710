"""The thesis's quantisation after training, of linear layers only."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

from edp.data.series import Series
from edp.evaluation.controller import Estimate
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.training.compression.int8 import dynamic_int8
from edp.workflows.compression.formats.base import FORMATS, Predict


@FORMATS.register("dynamic_int8")
class DynamicInt8:
    """8-bit weights in linear layers, whose inputs are rounded anew at every tick; the rest in single precision.

    Most multiply-accumulates stay in float, so the cycles are taken to be those of single precision.
    """

    label: ClassVar[str] = "INT8"
    # No code is exported in this format; cycles of single precision stand for it.
    estimated: ClassVar[str] = "float32"
    rounded: ClassVar[bool] = False

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """One byte for each weight of a linear layer, four for the others, as in Table 4.9; no code is exported."""
        return dynamic_int8(predictor).weight_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """A copy that computes with the rounded numbers."""
        return partial(stream_predictions, dynamic_int8(predictor).predictor)
