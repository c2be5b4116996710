"""Trainings that keep the source: rehearsal, distillation from its network, adversarial training (thesis 5.5.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from edp.data.series import Series
from edp.data.task import Task
from edp.networks.losses import Huber, compute_masked_loss
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.settings.bounds import MAX_WEIGHT, SHARE, WEIGHT, check_bounds, span
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext
from edp.training.warm_start import WarmStart

TARGET, SOURCE = 0.0, 1.0
HIDDEN = 64
# The steepness of Ganin et al. (2016).
STEEPNESS = 10.0


@dataclass(frozen=True, kw_only=True)
class BothSpec:
    """Weight of the source domain relative to the target.

    Attributes:
        weight: weight of the source's loss; the target's loss has weight one.
        soft: share of it that compares with what the source's network says, not with the truth.
        reversal: weight of the reversed gradient of a classifier of the two domains; 0 for none.

    Raises:
        ConfigError: a value out of range.
    """

    weight: float = 1.0
    soft: float = 0.0
    reversal: float = 0.0

    def __post_init__(self) -> None:
        check_bounds("both domains", self, weight=WEIGHT, soft=SHARE, reversal=span(0.0, MAX_WEIGHT))


class BothDomains:
    """Continued training of the source's network with recordings of both domains, in equal fractions of samples.

    Args:
        start: the source's network.
        kept: training series of the source, with truth.
        spec: weights of the domains.
    """

    def __init__(self, start: Predictor, source_series: Sequence[Series], spec: BothSpec) -> None:
        self.base, self.source_series, self.spec = WarmStart(start), list(source_series), spec

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the series of both domains, the shorter repeated.

        With their domain and the source network's predictions.
        """
        own = [self._mark_domain(part, TARGET, None) for part in own_series]
        source_predictions = (
            stream_predictions(self.base.start, self.source_series)
            if self.spec.soft
            else [None] * len(self.source_series)
        )
        rehearsed = [
            self._mark_domain(part, SOURCE, values)
            for part, values in zip(self.source_series, source_predictions, strict=True)
        ]
        ticks = [sum(part.samples for part in parts) for parts in (own, rehearsed)]
        # Equal shares of ticks: hours of the source would drown minutes of the target.
        # The arrays are shared, so to name a series again takes no memory.
        own, rehearsed = (
            parts * max(1, round(max(ticks) / n)) for parts, n in zip((own, rehearsed), ticks, strict=True)
        )
        return [*own, *rehearsed]

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Copy weights and scaling; add the classifier, if there is one."""
        self.base.begin(net, spec)
        if self.spec.reversal:
            x = torch.zeros(1, 1, len(net.task.inputs))
            with torch.no_grad():
                width = int(net.forward_features(x, net.initial_state(1, x))[2].shape[-1])
            # The classifier draws apart from the network, so that it does not change the network's dropout.
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(spec.seed)
                net.add_module("classifier", Classifier(width))
            self._classifier = net.get_submodule("classifier")
        return True

    def loss(self, objective: Objective, batch: BatchContext) -> Tensor:
        """Return the sum of the losses of target, source, and classifier with reversed gradient."""
        spec, domain = self.spec, batch.strategy_columns[..., 0]
        # The domain is a number among the targets; half separates 0 from 1.
        here, there = batch.valid & (domain < 0.5), batch.valid & (domain > 0.5)
        loss = objective.evaluate(batch.answer, batch.future, batch.features, here)
        if spec.soft < 1:
            truth = objective.evaluate(batch.answer, batch.future, batch.features, there)
            loss = loss + spec.weight * (1 - spec.soft) * truth
        if spec.soft:
            source_predictions = batch.strategy_columns[..., 1:].unflatten(-1, batch.future.shape[2:])
            goal = objective.code.encode(source_predictions, batch.features)
            soft = compute_masked_loss(Huber(), batch.answer, goal, there, objective.weights)
            loss = loss + spec.weight * spec.soft * soft
        if spec.reversal:
            hidden = reverse(batch.hidden, spec.reversal * ramp(batch.progress))
            loss = loss + self._confusion(self._classifier(hidden), here, there)
        return loss

    def end(self, net: Predictor) -> None:
        """Take the classifier away."""
        if self.spec.reversal:
            del net.classifier
        self.base.end(net)

    def _confusion(self, logits: Tensor, here: Tensor, there: Tensor) -> Tensor:
        """Return the cross-entropy of the classifier, both domains with equal weight."""
        parts = [
            nn.functional.binary_cross_entropy_with_logits(domain_logits, torch.full_like(domain_logits, domain))
            for domain_logits, domain in ((logits[here], TARGET), (logits[there], SOURCE))
            if domain_logits.numel()
        ]
        # A batch of one domain still gives a loss; a batch of none gives zero with a gradient path.
        return torch.stack(parts).mean() if parts else logits.sum() * 0.0

    def _mark_domain(self, part: Series, domain: float, source_predictions: np.ndarray[Any, Any] | None) -> Series:
        columns = [np.full((part.samples, 1), domain, dtype=np.float32)]
        if self.spec.soft:
            width = len(self.base.start.task.horizons) * len(self.base.start.task.targets)
            prediction_columns = (
                np.zeros((part.samples, width))
                if source_predictions is None
                else source_predictions.reshape(part.samples, -1)
            )
            columns.append(prediction_columns.astype(np.float32))
        return replace(part, strategy_columns=np.concatenate(columns, axis=1))


class Classifier(nn.Module):
    """Domain classifier on the backbone's representation: ``(..., width)`` to logits ``(...)``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(width, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        """Return the logits; positive for the source."""
        logits: Tensor = self.layers(hidden)
        return logits.squeeze(-1)


def ramp(progress: float) -> float:
    """Return ``2 / (1 + exp(-10 p)) - 1``: the adversary comes in slowly (Ganin et al. 2016, arXiv 1505.07818)."""
    return 2.0 / (1.0 + math.exp(-STEEPNESS * progress)) - 1.0


class _Reverse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        # A view: autograd skips functions that return their input itself.
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return -ctx.factor * grad, None


def reverse(values: Tensor, factor: float) -> Tensor:
    """Return the values unchanged; their gradient is multiplied by ``-factor``."""
    result: Tensor = _Reverse.apply(values, factor)  # type: ignore[no-untyped-call]
    return result
