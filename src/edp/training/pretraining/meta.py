"""Common part of the meta-learners: machine episodes, and evaluation after adaptation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edp.data.chunks import Sampler, cut, stack
from edp.data.episodes import EpisodeSampler, group_by_machine
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import Task
from edp.errors import DataError
from edp.networks.decomposition import decompose
from edp.networks.predictor import Predictor
from edp.training.adaptation import Pieces, Weights, adapt
from edp.training.objective import Objective
from edp.training.pretraining.spec import MetaSpec
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext
from edp.training.validation import validation_scores
from edp.training.warm_start import continue_from


class Meta(ABC):
    """A strategy of episodes: each update adapts to some machines and minimises the error after adaptation.

    Args:
        spec: the inner loop.
        start: a network to begin with; None begins at random.
    """

    def __init__(self, spec: MetaSpec, start: Predictor | None = None) -> None:
        self.spec, self.start = spec, start

    @property
    def passes(self) -> int:
        """Number of passes through the network in the backward pass of an update."""
        # The gradient passes through every inner step and the query, so memory grows with their number.
        return 1 + self.spec.inner_steps

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series unchanged."""
        return list(own_series)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Take over the weights and scaling of the start, which then is a candidate itself."""
        self.training = spec
        parts = decompose(net)
        # The head alone adapts where the representation is to stay common to all machines.
        self.adapted = frozenset(parts.head) if self.spec.head_only else frozenset((*parts.head, *parts.encoding))
        if self.start is None:
            return False
        continue_from(net, self.start)
        return True

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the loss; not called, since episodes have their own cost."""
        return objective.evaluate(
            batch_context.answer, batch_context.future, batch_context.features, batch_context.valid
        )

    def end(self, net: Predictor) -> None:  # noqa: B027 - part of the interface; there is nothing to undo
        """End the strategy, which has changed only weights."""

    def sampler(self, series: Sequence[Series], task: Task, spec: TrainingSpec) -> Sampler:
        """Return the episodes of the machines that train."""
        return EpisodeSampler(series, task.horizons, spec.chunks, self.spec.shots, spec.seed)

    def episode(self, net: Predictor, objective: Objective, batch: Pieces) -> Tensor:
        """Return the mean cost of the machines of a batch."""
        shots = self.spec.shots
        costs = []
        for first in range(0, len(batch[0]), 2 * shots):
            support = tuple(part[first : first + shots] for part in batch)
            query = tuple(part[first + shots : first + 2 * shots] for part in batch)
            costs.append(self.cost(net, objective, support, query))  # type: ignore[arg-type]
        return torch.stack(costs).mean()

    @abstractmethod
    def cost(self, net: Predictor, objective: Objective, support: Pieces, query: Pieces) -> Tensor:
        """Return the cost of one machine, a scalar with the gradient to descend."""

    def start_of(self, net: Predictor) -> Weights:
        # Frozen parameters do not adapt: their gradient would be missing.
        """Return the weights that adapt."""
        return {name: p for name, p in net.named_parameters() if name in self.adapted and p.requires_grad}

    def judge(self, net: Predictor, objective: Objective, data: Prepared) -> tuple[float, float, float]:
        """Return the errors after adaptation to each validation machine: one half adapts, the other is evaluated.

        Raises:
            DataError: a series is too short to be halved.
        """
        total, ticks = np.zeros(3), 0
        for places in group_by_machine(data.validation).values():
            parts = [data.validation[index] for index in places]
            support, rest = self._halves(net, parts)
            adapted_parameters = self.start_of(net)
            saved_parameters = {name: tensor.detach().clone() for name, tensor in adapted_parameters.items()}
            adapted_values = adapt(net, adapted_parameters, objective, support, self.spec.steps)
            with torch.no_grad():
                for name, tensor in adapted_parameters.items():
                    tensor.copy_(adapted_values[name])
            try:
                scores = validation_scores(net, rest, self.training, data)
            finally:
                with torch.no_grad():
                    for name, tensor in adapted_parameters.items():
                        tensor.copy_(saved_parameters[name])
            count = sum(part.samples for part in rest)
            # Machines count by their ticks, as joint training would count them.
            total, ticks = total + count * np.array(scores), ticks + count
        score, report, loss = (float(value) for value in total / ticks)
        return score, report, loss

    def _halves(self, net: Predictor, parts: Sequence[Series]) -> tuple[Pieces, list[Series]]:
        # The first half adapts and the second judges: the order on a machine, too.
        """Return the segments of the first halves, as many as an episode has, and the second halves."""
        chunks, horizons = self.training.chunks, net.task.horizons
        starts, rest = [], []
        for index, part in enumerate(parts):
            half = part.samples // 2
            if half <= chunks.length + net.task.max_horizon:
                raise DataError(
                    f"validation recording '{part.name}' has {part.samples} samples; its first half adapts and must be "
                    f"longer than a piece of {chunks.length} plus the horizon: give longer recordings or a smaller "
                    "training.chunks.length"
                )
            starts += [(index, at) for at in range(0, half - chunks.length - net.task.max_horizon, chunks.length)]
            rest.append(replace(part, inputs=part.inputs[half:], targets=part.targets[half:]))
        # Even distances over the first halves: neighbouring pieces would show one kind of work.
        chosen = [starts[i * len(starts) // self.spec.shots] for i in range(min(self.spec.shots, len(starts)))]
        rows = [cut(parts[i], range(at, at + chunks.length), horizons, chunks.burn_in) for i, at in chosen]
        batch = stack(rows, [True] * len(rows))
        like = next(net.parameters())
        x, future, valid = (torch.from_numpy(v).to(like.device) for v in (batch.inputs, batch.future, batch.valid))
        return (x, future, valid), rest
