"""Centring: the mean error of a trained network taken out of its head.

A loss that is nearly linear finds the median of what may come. Where errors are skewed, as in soil, the mean stays off
by some percent of the mean absolute error, and a plant model in a closed loop integrates it to a drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.data.task import Task
from edp.networks.predictor import Predictor
from edp.networks.running import stream_errors
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext, TrainingStrategy

ROUNDS = 6  # one is enough unless the heads end in a function that bends
# A tenth: less would divide by noise where the heads hardly answer.
MIN_ANSWER = 0.1
CLOSE = 0.005  # of the mean absolute error that may be left
SHORTEST_S = 30.0  # of logs: the mean error of fewer says little of other logs
DEAREST = 1.01  # most that it may cost of the mean absolute error


class Centred:
    """A strategy after which the mean error over the training series is subtracted from the trained network.

    Args:
        base: the strategy itself.
    """

    def __init__(self, base: TrainingStrategy) -> None:
        self.base = base
        self._known: list[Series] = []

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the series of the base strategy."""
        self._known = list(own_series)
        return self.base.series(task, own_series)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Begin like the base strategy."""
        return self.base.begin(net, spec)

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the loss of the base strategy."""
        return self.base.loss(objective, batch_context)

    def end(self, net: Predictor) -> None:
        """End the base strategy, and centre its result, unless the logs are too short for a mean to hold elsewhere."""
        self.base.end(net)
        if sum(part.samples for part in self._known) >= SHORTEST_S * net.task.rate_hz:
            centre(net, self._known)


def centre(net: Predictor, series: Sequence[Series]) -> None:
    """Shift the last biases of the heads so that the mean error over `series` is zero.

    What would raise the mean absolute error of a horizon and target by more than a hundredth is left as it was, and
    everything is where no series is longer than a window.

    Args:
        net: a trained network, changed in place.
        series: series with measured targets; each starts from a reset and counts after a whole window.
    """
    bias = net.heads.biases[-1]  # (target, horizon * value), of which the first value is the prediction
    before = bias.detach().clone()
    mean, size = _errors(net, series)
    # Recordings too short to be judged leave the network as it is.
    if not np.isfinite(size).all():
        return
    allowed, answered = DEAREST * size, np.ones_like(size)
    for _ in range(ROUNDS):
        step = np.where(np.abs(mean) > CLOSE * size, mean / answered, 0.0)
        if not step.any():
            break
        _shift(net, -step)
        last, (mean, size) = mean, _errors(net, series)
        # A bent end of the heads answers with less than it is given.
        share = np.divide(last - mean, step, out=np.ones_like(step), where=step != 0.0)
        answered = np.where(step != 0.0, np.clip(share, MIN_ANSWER, 1.0), answered)
    # Outputs for which centring costs more than it brings get their bias back.
    dear = torch.from_numpy(size > allowed).transpose(0, 1).to(bias.device)
    with torch.no_grad():
        own = bias[:, :: net.spec.output.values]
        own.copy_(torch.where(dear, before[:, :: net.spec.output.values], own))


def _shift(net: Predictor, change: NDArray[np.float64]) -> None:
    """Add a change in SI units, ``(horizon, target)``, to the head outputs."""
    bias = net.heads.biases[-1]
    features = torch.zeros(1, 1, len(net.task.features.features), device=bias.device)
    future = torch.as_tensor(change, dtype=torch.float32, device=bias.device)[None, None]
    # The difference of two encoded targets is the change in network units, for any offset of the scaling.
    coded: Tensor = net.code.encode(future, features) - net.code.encode(torch.zeros_like(future), features)
    with torch.no_grad():
        bias[:, :: net.spec.output.values] += coded[0, 0].transpose(0, 1)


def _errors(net: Predictor, series: Sequence[Series]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean error and mean absolute error, SI units, ``(horizon, target)``; NaN without evaluated samples."""
    horizons, targets = len(net.task.horizons), len(net.task.targets)
    total, size, ticks = np.zeros((horizons, targets)), np.zeros((horizons, targets)), np.zeros((horizons, 1))
    for index, error in stream_errors(net, series):
        total[index] += error.sum(axis=0, dtype=np.float64)
        size[index] += np.abs(error).sum(axis=0, dtype=np.float64)
        ticks[index] += len(error)
    # No ticks give NaN, which the caller looks for.
    with np.errstate(invalid="ignore"):
        return total / ticks, size / ticks
