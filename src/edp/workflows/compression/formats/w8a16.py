"""8-bit weights and 16-bit numbers everywhere, as the exported integer code computes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

from edp.data.series import Series
from edp.evaluation.controller import Estimate
from edp.networks.integer import integer_predictor
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.workflows.compression.formats.base import FORMATS, Predict


@FORMATS.register("w8a16")
class W8A16:
    """Static quantisation of the whole network, judged in integer arithmetic (`edp.ir.w8a16`).

    A network that has no integer form is refused by name.
    """

    label: ClassVar[str] = "W8A16"
    estimated: ClassVar[str] = "w8a16"
    rounded: ClassVar[bool] = True

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """All constants of the exported C code."""
        return estimate.parameter_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """Ranges and weights are chosen on `training_series`."""
        return partial(stream_predictions, integer_predictor(predictor, training_series))
