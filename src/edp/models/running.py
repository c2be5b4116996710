"""Run a predictor over whole recordings as a stream, several side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.models.predictor import Predictor

PIECE = 512  # ticks per call: long enough for speed, short enough for memory


def stream_predictions(predictor: Predictor, series: Sequence[Series], batch: int = 16) -> list[NDArray[np.float32]]:
    """Predictions for every tick of every series, each from reset, state carried to its end.

    Returns:
        For each series float32 ``(time, horizon, target)`` in SI units: row t is the prediction made at t.
    """
    device = next(predictor.parameters()).device
    order = sorted(range(len(series)), key=lambda i: series[i].samples)
    results: dict[int, NDArray[np.float32]] = {}
    was_training = predictor.training
    predictor.eval()
    try:
        with torch.inference_mode():
            for at in range(0, len(order), batch):
                group = order[at : at + batch]
                for index, values in zip(group, _run_group(predictor, [series[i] for i in group], device), strict=True):
                    results[index] = values
    finally:
        predictor.train(was_training)
    return [results[i] for i in range(len(series))]


def _run_group(predictor: Predictor, group: list[Series], device: torch.device) -> list[NDArray[np.float32]]:
    longest = max(part.samples for part in group)
    like = next(predictor.parameters())
    state = predictor.initial_state(len(group), like)
    out: list[list[NDArray[np.float32]]] = [[] for _ in group]
    for start in range(0, longest, PIECE):
        stop = min(start + PIECE, longest)
        rows = np.arange(start, stop)
        # A shorter stream repeats its last tick; those predictions are cut off below.
        x = np.stack([part.inputs[np.minimum(rows, part.samples - 1)] for part in group])
        y, state = predictor.predict(torch.from_numpy(x).to(device=device, dtype=like.dtype), state)
        values = y.float().cpu().numpy()
        for i, part in enumerate(group):
            if start < part.samples:
                out[i].append(values[i, : part.samples - start])
    return [np.concatenate(pieces) for pieces in out]


class Stream:
    """A predictor run tick by tick, as on the machine: feed one row of SI inputs, read one prediction.

    Args:
        predictor: the network; it is put in evaluation mode.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.predictor = predictor.eval()
        self._like = next(predictor.parameters())
        self.reset()

    def reset(self) -> None:
        """Forget all ticks."""
        self._state = self.predictor.initial_state(1, self._like)
        self.ticks = 0

    @property
    def warm(self) -> bool:
        """True once a whole window has been seen."""
        return self.ticks >= self.predictor.spec.window

    def step(self, inputs: Sequence[float] | NDArray[np.floating] | Tensor) -> NDArray[np.float32]:
        """Feed one tick ``(input,)`` in SI units; returns the prediction ``(horizon, target)`` in SI units."""
        x = torch.as_tensor(inputs, dtype=self._like.dtype, device=self._like.device).reshape(1, 1, -1)
        with torch.inference_mode():
            y, self._state = self.predictor.predict(x, self._state)
        self.ticks += 1
        result: NDArray[np.float32] = y[0, 0].float().cpu().numpy()
        return result
