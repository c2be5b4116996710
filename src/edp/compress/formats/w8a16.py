"""8-bit weights and 16-bit activations everywhere, with fixed ranges."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

from edp.compress.formats.base import FORMATS, Predict
from edp.compress.rounding import Rounding, matrices_of
from edp.data.series import Series
from edp.evaluation.footprint import Footprint
from edp.models.predictor import Predictor
from edp.models.running import stream_predictions

ACTIVATION_BITS = 16


@FORMATS.register("w8a16")
class W8A16:
    """Static quantisation: weights have a step for each output, activations a fixed range found on training series.

    Judged in float with rounded numbers, as quantisation-aware training sees them.
    """

    label: ClassVar[str] = "W8A16"
    estimated: ClassVar[str] = "w8a16"
    rounded: ClassVar[bool] = True

    def parameter_bytes(self, predictor: Predictor, counts: Footprint) -> int:
        """One byte for each weight of a multiply-accumulate, four for the others, after folding."""
        weights = sum(matrix.values.numel() for matrix in matrices_of(predictor))
        return 4 * counts.parameters_folded - 3 * weights

    def predictions(self, predictor: Predictor, known: Sequence[Series]) -> Predict:
        """A copy that computes with the rounded numbers."""
        made = copy.deepcopy(predictor).eval()
        Rounding(made, ACTIVATION_BITS).install(known)
        return partial(stream_predictions, made)
