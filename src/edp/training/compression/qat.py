"""Quantisation-aware training: continued training with rounded arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import ConfigError
from edp.networks.predictor import Predictor
from edp.training.compression.rounding import NetworkRounding
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext, TrainingStrategy
from edp.training.warm_start import continue_from


@dataclass(frozen=True, kw_only=True)
class RoundingSpec:
    """Roundings in training; weights have 8 bits, with one step size per output.

    Attributes:
        activation_bits: bits of the inputs of convolutions, recurrent and linear layers: 16, 8 (experimental), or 0 for
            no rounding.
        recurrent: False leaves the matrices of recurrent layers in float, as the thesis does (3.3.7).

    Raises:
        ConfigError: other bits.
    """

    activation_bits: int = 16
    recurrent: bool = True

    def __post_init__(self) -> None:
        if self.activation_bits not in (0, 8, 16):
            raise ConfigError(f"rounding: activation_bits = {self.activation_bits}; 16, 8 or 0 must hold")


class QuantisationAware:
    """Training that continues from a trained network with rounded weights and activations (straight-through gradients).

    The network is validated rounded, and the start is a candidate itself. What training leaves is an ordinary float
    network whose rounded weights lie on their grid: to round them again, with a step for each output, changes nothing.

    Args:
        start: a trained network; the training must be of its own specs.
        strategy: teachers, see `Distillation`; None learns from the truth alone.
        spec: values to round.
    """

    def __init__(
        self, start: Predictor, strategy: TrainingStrategy | None = None, spec: RoundingSpec | None = None
    ) -> None:
        self.start, self.strategy, self.spec = start, strategy, spec or RoundingSpec()
        self._known: Sequence[Series] = ()
        self._rounding: NetworkRounding | None = None

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the training series with the teachers' outputs, if there are teachers."""
        # Ranges are found on the run's own series: those of a teacher may hold unlabelled recordings.
        self._known = own_series
        return list(own_series) if self.strategy is None else self.strategy.series(task, own_series)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Go on from the start, rounded; ranges of activations are found on the training series.

        Raises:
            ConfigError: the start has other specs.
        """
        if self.strategy is not None:
            self.strategy.begin(net, spec)
        # The start replaces what the strategy has set, since training goes on from it.
        continue_from(net, self.start)
        self._rounding = NetworkRounding(net, self.spec.activation_bits, self.spec.recurrent)
        self._rounding.install(self._known)
        # The rounded start is a candidate: training must improve on it.
        return True

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the loss of the teachers' strategy.

        Raises:
            ConfigError: there are no teachers.
        """
        if self.strategy is None:
            raise ConfigError(
                "quantisation-aware training: series carry teacher targets, but there is no teacher; give one"
            )
        return self.strategy.loss(objective, batch_context)

    def end(self, net: Predictor) -> None:
        """Leave an ordinary network with rounded weights."""
        if self._rounding is not None:
            # Hooks go first: they would round what is being set.
            self._rounding.remove()
            self._rounding.keep()
            self._rounding = None
        if self.strategy is not None:
            self.strategy.end(net)
