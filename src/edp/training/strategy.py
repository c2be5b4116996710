"""Training strategies: initial weights and teachers in addition to the data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from edp.data.chunks import Sampler
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import Task
from edp.networks.losses import Prediction
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.objective import Objective
from edp.training.outcome import Fitted, TrainingProgress
from edp.training.spec import TrainingSpec


@dataclass(frozen=True, eq=False)
class BatchContext:
    """A batch as a training strategy sees it.

    Attributes:
        answer: output of the network, standardised.
        future: targets, SI units, ``(batch, time, horizon, output)``.
        features: physical, ``(batch, time, feature)``.
        hidden: representation of the backbone, ``(batch, time, width)``.
        valid: ``(batch, time)``: ticks that count.
        strategy_columns: ``(batch, time, column)``: what `series` gave this strategy to read of these ticks.
        progress: share of the training that is done, from 0 to 1.
    """

    answer: Prediction
    future: Tensor
    features: Tensor
    hidden: Tensor
    valid: Tensor
    strategy_columns: Tensor
    progress: float = 0.0


class TrainingStrategy(Protocol):
    """Initial weights, training series, and the loss of a batch."""

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series with teacher outputs, and additional series.

        Either all of them have `strategy_columns` or none; where none has, `loss` is not asked.
        """
        ...

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Set weights before the first update; whether the network is a candidate as it then is.

        Raises:
            ConfigError: the strategy does not fit the network or the regime of training.
        """
        ...

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the loss of a batch; `objective` gives the loss on measured targets."""
        ...

    def end(self, net: Predictor) -> None:
        """Undo the changes of `begin` to the network except the weights, which are now the best ones."""
        ...


@runtime_checkable
class StreamStrategy(TrainingStrategy, Protocol):
    """Training strategy that conditions the network on each stream before it processes a chunk."""

    def tell(self, net: Predictor, strategy_columns: Tensor, reset: Tensor) -> None:
        """Set the condition from ``(batch, time, column)``.

        `reset` ``(batch,)`` marks streams that restart with this chunk.
        """
        ...


@runtime_checkable
class DirectFit(Protocol):
    """Fits the network by itself, without the loop over chunks."""

    def fit_network(
        self, data: Prepared, model: ModelSpec, spec: TrainingSpec, on_event: Callable[[TrainingProgress], None]
    ) -> Fitted:
        """Train the network of `model` on ``data.train`` and ``data.validation``.

        Raises:
            EdpError: the data or settings cannot be used.
        """
        ...


@runtime_checkable
class EpisodicStrategy(TrainingStrategy, Protocol):
    """Training strategy with its own batches; each update trains on one part of a batch and evaluates the other."""

    def sampler(self, series: Sequence[Series], task: Task, spec: TrainingSpec) -> Sampler:
        """Create the source of batches; all streams of a batch start from reset.

        Raises:
            DataError: the series cannot be dealt out so.
        """
        ...

    def episode(self, net: Predictor, objective: Objective, batch: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Return the cost of a batch (inputs, future targets and validity), a scalar with the gradient to descend."""
        ...

    def judge(self, net: Predictor, objective: Objective, data: Prepared) -> tuple[float, float, float]:
        """Return the scores that select the best epoch, like `edp.training.validation.validation_scores`.

        `net` is unchanged.
        """
        ...
