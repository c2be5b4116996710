"""Progress events and results of a training."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import EdpError, NotFiniteError
from edp.networks.predictor import Predictor
from edp.storage.reading import Table


class TrainingError(EdpError):
    """Training cannot continue."""


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training, for displays: after every few updates and after each epoch."""

    epoch: int
    epochs: int
    update: int
    updates: int
    targets_per_s: float
    seconds_left: float
    row: Table | None = None
    refit: bool = False

    @property
    def share(self) -> float:
        """Share of the training that is done."""
        return ((self.epoch - 1) * self.updates + self.update) / (self.epochs * self.updates)


@dataclass(frozen=True, eq=False)
class Fitted:
    """A trained predictor with its history.

    Attributes:
        predictor: predictor with the best weights, in evaluation mode.
        history: a row per epoch.
        seconds: training time over all sittings.
        targets_per_s: ticks with a loss per second of the update loop in this sitting.
        resumed_at: epoch at which this sitting began.
    """

    predictor: Predictor
    history: list[Table]
    seconds: float
    targets_per_s: float
    resumed_at: int


class Diverged(TrainingError, NotFiniteError):
    """The loss or the validation score is not finite any more.

    Attributes:
        fitted: the best weights before that, None where no epoch was finished.
        facts: position of the divergence, plain values.
    """

    exit_code = 4

    def __init__(self, message: str, fitted: Fitted | None, facts: Table) -> None:
        super().__init__(message)
        self.fitted, self.facts = fitted, facts
