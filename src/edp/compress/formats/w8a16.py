"""8-bit weights and 16-bit numbers everywhere, as the exported integer code computes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.compress.formats.base import FORMATS, Predict
from edp.compress.rounding import matrices_of
from edp.data.series import Series
from edp.evaluation.footprint import Footprint
from edp.graph import Graph
from edp.integer import Integers, calibrate, quantise
from edp.models.predictor import Predictor

STREAMS, PIECE = 16, 1024  # side by side, and ticks at a time


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
        graph = predictor.graph()
        made = quantise(graph, calibrate(graph, [part.inputs for part in known]))
        shape = (len(predictor.task.horizons), len(predictor.task.targets))
        return partial(stream_integers, made, shape)


def stream_integers(graph: Graph, shape: tuple[int, int], series: Sequence[Series]) -> list[NDArray[np.float32]]:
    """Predictions ``(time, *shape)`` of a whole-number graph for every tick of every series, each from reset."""
    order = sorted(range(len(series)), key=lambda place: series[place].samples)
    found: dict[int, NDArray[np.float32]] = {}
    for at in range(0, len(order), STREAMS):
        places = order[at : at + STREAMS]
        longest = series[places[-1]].samples
        run, parts = Integers(graph, len(places)), []
        for start in range(0, longest, PIECE):
            rows = np.arange(start, min(start + PIECE, longest))
            # A shorter stream repeats its last tick; those predictions are cut off below.
            x = [series[place].inputs[np.minimum(rows, series[place].samples - 1)] for place in places]
            parts.append(run.run(np.stack(x, axis=1))["prediction"])
        every = np.concatenate(parts)
        for stream, place in enumerate(places):
            found[place] = every[: series[place].samples, stream].reshape(-1, *shape)
    return [found[place] for place in range(len(series))]
