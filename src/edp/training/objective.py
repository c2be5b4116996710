"""Training objective: weighted main loss plus optional penalty terms."""

from __future__ import annotations

import torch
from torch import Tensor

from edp.networks.frontend import TargetTransform
from edp.networks.losses import Course, Prediction, compute_masked_loss, horizon_weights, output_weights
from edp.training.spec import TrainingSpec


class Objective:
    """The training loss of a batch; it remembers the running error of each output where weights adapt to it.

    Args:
        spec: settings of the training.
        code: code of the network's targets.

    Attributes:
        running: mean absolute error ``(horizon, output)`` in standard deviations, led on by `follow`.
    """

    def __init__(self, spec: TrainingSpec, code: TargetTransform) -> None:
        self.spec, self.code = spec, code
        self.weights = output_weights(code.width, spec.weight_power)
        self.weights = self.weights * horizon_weights(len(self.weights), spec.horizon_decay).to(self.weights)
        # Ones stand for errors of one standard deviation, which a network at the mean has.
        self.running = torch.ones_like(self.weights)

    def evaluate(self, answer: Prediction, future: Tensor, features: Tensor, valid: Tensor) -> Tensor:
        """Return the loss of a batch.

        Args:
            answer: output of the network.
            future: targets, SI units, ``(batch, time, horizon, output)``.
            features: physical, ``(batch, time, feature)``.
            valid: ``(batch, time)``: ticks that count.
        """
        target = self.code.encode(future, features)
        weights = self.weights
        if self.spec.adaptive.blend:
            weights = weights * self.spec.adaptive.weights(self.running)
            # Detached: the weights follow the error and must not be a way to lower the loss.
            self.running = self.spec.adaptive.follow(self.running, (answer.center - target).detach(), valid)
        loss = compute_masked_loss(self.spec.loss, answer, target, valid, weights)
        if self.spec.terms:
            course = self._course(answer.center, target, self.code.level(features), valid)
            for term in self.spec.terms:
                loss = loss + term.weight * term.evaluate(course)
        return loss

    def _course(self, predicted: Tensor, target: Tensor, level: Tensor, valid: Tensor) -> Course:
        """Return consecutive predictions: the samples of a chunk, or the last samples of windows sampled together."""
        chunks = self.spec.chunks
        if chunks.regime == "chunk":
            return Course(predicted, target, level, valid)

        def last(x: Tensor) -> Tensor:
            result: Tensor = x[:, -1].unflatten(0, (-1, chunks.consecutive))
            return result

        return Course(last(predicted), last(target), last(level), last(valid))
