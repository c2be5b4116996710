"""What a training may have besides its data: weights to begin with, and a teacher."""

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
        answer: what the network says, standardised.
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
    """Weights to begin with, series to learn from, and the loss of a batch of them."""

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """The training series with what is taught about them, and further series.

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
        """The loss of a batch; `objective` gives that of the truth."""
        ...

    def end(self, net: Predictor) -> None:
        """Take back what `begin` did to the network beside its weights; it has the best ones now."""
        ...


@runtime_checkable
class StreamStrategy(TrainingStrategy, Protocol):
    """A training strategy that sets what the network is told of each stream before it runs along a chunk."""

    def tell(self, net: Predictor, strategy_columns: Tensor, reset: Tensor) -> None:
        """Set it from ``(batch, time, column)`` and from which streams ``(batch,)`` start anew with this chunk."""
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
    """A training strategy that forms its own batches; each update learns from one and judges it."""

    def sampler(self, series: Sequence[Series], task: Task, spec: TrainingSpec) -> Sampler:
        """Where the batches come from; all streams of a batch start from reset.

        Raises:
            DataError: the series cannot be dealt out so.
        """
        ...

    def episode(self, net: Predictor, objective: Objective, batch: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """What a batch costs, a scalar with the gradient to go down; inputs, future targets and validity come in."""
        ...

    def judge(self, net: Predictor, objective: Objective, data: Prepared) -> tuple[float, float, float]:
        """What chooses the best epoch, as `edp.training.validation.validation_scores` gives it; `net` is left as is."""
        ...
