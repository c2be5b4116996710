"""Predictor in W8A16 arithmetic, equal to the controller's bit for bit; it is evaluated like any other predictor."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from edp.data.scaling import Scaler
from edp.data.series import Series
from edp.errors import ExportError
from edp.ir import Graph
from edp.ir.w8a16 import Formats, Integers, calibrate, quantise
from edp.ir.w8a16.arithmetic import LARGEST
from edp.networks.predictor import Predictor
from edp.networks.running import mean_error
from edp.networks.streaming import State

JUDGED_TICKS = 200_000
"""Approximate number of samples for choosing the input format. Values that a finer format would clip are rare."""


class IntegerPredictor(Predictor):
    """The integer form of a trained predictor; it cannot be trained.

    Args:
        source: the float network.
        chosen: formats of its values.

    Attributes:
        formats: formats of its values.
        integers: its layers.

    Raises:
        ExportError: a part of the network has no integer form.
    """

    number_format = "w8a16"

    def __init__(self, source: Predictor, chosen: Formats) -> None:
        # A network that has no integer form is refused before anything is built.
        integers = quantise(source.graph(), chosen)
        numbers = (source.front.offset, source.front.width, source.code.offset, source.code.width)
        offset, width, zero, unit = (part.detach().cpu().double().numpy() for part in numbers)
        super().__init__(source.task, source.spec, Scaler(offset, width, zero, unit))
        self.load_state_dict(source.state_dict())
        self.formats = chosen
        self.integers: Graph = integers
        self.eval()

    def to_float_network(self) -> Predictor:
        """Return the network in single precision from which it was quantised, for counting or fine-tuning."""
        offset, width = (part.double().numpy() for part in (self.front.offset, self.front.width))
        zero, unit = (part.double().numpy() for part in (self.code.offset, self.code.width))
        float_predictor = Predictor(self.task, self.spec, Scaler(offset, width, zero, unit))
        float_predictor.load_state_dict(self.state_dict())
        return float_predictor.eval()

    def initial_state(self, batch: int, like: Tensor) -> State:
        """State at reset for `batch` streams."""
        return Integers(self.integers, batch)

    def predict(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the predictions in SI units, ``(batch, time, horizon, target)``, and the next state."""
        results, new = self._run(x, state)
        return self._reshape_outputs(results["prediction"], x), new

    def intervals(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the bounds in SI units ``(batch, time, coverage, 2, horizon, target)``, lower then upper.

        And the next state.
        """
        results, new = self._run(x, state)
        return self._sides(results, x), new

    def predict_with_intervals(self, x: Tensor, state: State) -> tuple[Tensor, Tensor | None, State]:
        """Return the results of `predict` and `intervals` from one pass.

        Bounds are None for outputs without intervals.
        """
        results, new = self._run(x, state)
        bounds = self._sides(results, x) if self.output.coverages else None
        return self._reshape_outputs(results["prediction"], x), bounds, new

    def _sides(self, results: dict[str, np.ndarray], x: Tensor) -> Tensor:
        """Return the bounds in SI units ``(batch, time, coverage, 2, horizon, target)``."""
        sides = [self._reshape_outputs(results[side], x, len(self.output.coverages)) for side in ("lower", "upper")]
        return torch.stack(sides, dim=3)

    def forward_features(self, x: Tensor, state: State) -> NoReturn:
        """Raise an error: hidden features do not exist in integer arithmetic.

        Raises:
            ExportError: always.
        """
        raise ExportError("a network in w8a16 gives predictions only; train, teach and look inside with the float run")

    def _run(self, x: Tensor, state: State) -> tuple[dict[str, np.ndarray], State]:
        # A deep copy keeps the caller's state valid, as the float network does.
        new = deepcopy(state)
        return new.run(x.detach().cpu().float().numpy().transpose(1, 0, 2)), new

    def _reshape_outputs(self, values: np.ndarray, like: Tensor, *more: int) -> Tensor:
        sizes = (*more, len(self.task.horizons), len(self.task.targets))
        rows = torch.from_numpy(np.ascontiguousarray(values.transpose(1, 0, 2)))
        return rows.reshape(*rows.shape[:2], *sizes).to(like)


def integer_predictor(predictor: Predictor, series: Sequence[Series], ticks: int = 20_000) -> IntegerPredictor:
    """Quantise a trained network; formats and weights are chosen on `series`, its training part.

    Raises:
        ExportError: a part of the network has no integer form.
    """
    some = spread(series, JUDGED_TICKS)
    inputs = [part.inputs for part in series]
    calibration = calibrate(predictor.graph(), inputs, ticks, lambda frac: _error_with(predictor, some, frac))
    return IntegerPredictor(predictor, calibration)


def spread(series: Sequence[Series], ticks: int) -> list[Series]:
    """Return evenly spaced series with about `ticks` samples in total, at least one series."""
    # A stride over recordings keeps the mix of drives; the first recordings alone could be one kind of work.
    every = max(1, round(sum(part.samples for part in series) / ticks))
    return list(series[::every])


def _error_with(predictor: Predictor, series: Sequence[Series], frac: int) -> float:
    """Return the mean absolute error of the float network with standardised inputs in a 16-bit format."""
    rounded = deepcopy(predictor)
    scale, unit = rounded.front.scale, 2.0**-frac

    def scaled(features: Tensor) -> Tensor:
        # Apply only rounding and clamping, because the comparison concerns the format of the inputs, not of the
        # weights.
        return (scale(features) / unit).round().clamp(-LARGEST, LARGEST) * unit

    rounded.front.scale = scaled  # type: ignore[method-assign]
    return mean_error(rounded, series)
