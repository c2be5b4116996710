"""8-bit weights and 16-bit numbers everywhere, as the exported integer code computes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

from edp.compress.formats.base import FORMATS, Predict
from edp.compress.rounding import matrices_of
from edp.data.series import Series
from edp.evaluation.footprint import Footprint
from edp.models.integer import integer_predictor
from edp.models.predictor import Predictor
from edp.models.running import stream_predictions


@FORMATS.register("w8a16")
class W8A16:
    """Static quantisation of the whole network, judged in whole numbers (`edp.integer`).

    A network that has no form in whole numbers is refused by name.
    """

    label: ClassVar[str] = "W8A16"
    estimated: ClassVar[str] = "w8a16"
    rounded: ClassVar[bool] = True

    def parameter_bytes(self, predictor: Predictor, counts: Footprint) -> int:
        """One byte for each weight of a multiply-accumulate, four for the others, after folding."""
        weights = sum(matrix.values.numel() for matrix in matrices_of(predictor))
        return 4 * counts.parameters_folded - 3 * weights

    def predictions(self, predictor: Predictor, known: Sequence[Series]) -> Predict:
        """Ranges and weights are chosen on `known`."""
        return partial(stream_predictions, integer_predictor(predictor, known))
