"""Orders of smaller networks as plain values, and the bench that carries them out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.networks.narrow import student, width_of
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.compression.committee import committee_start
from edp.training.compression.distillation import Distillation, DistillationSpec
from edp.training.compression.imitation import CommitteeImitation, imitates
from edp.training.compression.pruning import prune
from edp.training.compression.qat import QuantisationAware, RoundingSpec
from edp.training.fit import fit
from edp.training.spec import TrainingSpec, to_gradient_training
from edp.training.strategy import DirectFit, TrainingStrategy

# Training with rounded numbers goes on from a trained network: shorter, and in smaller steps.
TUNING_EPOCHS, TUNING_RATE = 1 / 3, 1 / 5


@dataclass(frozen=True, kw_only=True)
class CompressionRequest:
    """Request to train a smaller network from a teacher.

    Attributes:
        name: name of the network.
        units: width of the network, at most the width of the teacher.
        levels: convolution levels; None lets `student` choose.
        pruned: whether training starts from the pruned teacher, which requires all convolution levels.
        distillation: objective; None for `DistillationSpec()`, or for a student that imitates bank rows (`imitates`).
        rounding: number format that the training simulates, starting from the network of the request `of`.
        of: request whose network a training with rounding continues; None for the teacher.
    """

    name: str
    units: int
    levels: int | None = None
    pruned: bool = False
    distillation: DistillationSpec | None = None
    rounding: RoundingSpec | None = None
    of: CompressionRequest | None = None

    @property
    def begins_pruned(self) -> bool:
        """Test whether the network, or its start network, begins with the pruned teacher."""
        return self.pruned if self.of is None else self.of.begins_pruned

    def model(self, teacher: ModelSpec) -> ModelSpec:
        """Return the network's settings."""
        if self.of is not None:
            return self.of.model(teacher)
        # Rounding alone needs no narrower network.
        if self.units == width_of(teacher) and self.rounding is not None:
            return teacher
        channels = getattr(teacher.backbone, "channels", None)
        # A pruned student keeps every level: weights of a level cannot be moved to another one.
        every = None if channels is None else len(channels)
        return student(teacher, self.units, every if self.pruned else self.levels)

    def training(self, spec: TrainingSpec) -> TrainingSpec:
        """Return the training of this network, given the general training `spec`."""
        spec = to_gradient_training(spec)  # a student is taught; there are no folds of truth
        return spec if self.rounding is None else tuning(spec)

    def strategy(
        self, teachers: Sequence[Predictor], data: Prepared, start: Predictor | None, further: Sequence[Series] = ()
    ) -> TrainingStrategy | DirectFit:
        """Return the strategy of the training; `start` is the network of `of`.

        Raises:
            ConfigError: teachers that contradict one another, or a network that cannot be pruned.
        """
        model = self.model(teachers[0].spec)
        if self.on_rows(teachers):
            return CommitteeImitation(teachers[0], further)
        narrow = prune(teachers[0], model, data.train) if self.pruned else committee_start(teachers[0], model, data)
        strategy = Distillation(teachers, self.distillation, further, narrow)
        if self.rounding is None:
            return strategy
        return QuantisationAware(teachers[0] if start is None else start, strategy, self.rounding)

    def on_rows(self, teachers: Sequence[Predictor]) -> bool:
        """Return whether the student learns on rows of the teacher's bank.

        A committee's does where no objective is given.
        """
        if self.distillation is not None or self.rounding is not None or self.pruned:
            return False
        return imitates(teachers, self.model(teachers[0].spec))


def tuning(spec: TrainingSpec) -> TrainingSpec:
    """Return a third of the epochs, and a fifth of the learning rate if the optimiser has one."""
    optimizer: Any = spec.optimizer
    if any(entry.name == "learning_rate" for entry in fields(optimizer)):
        optimizer = replace(optimizer, learning_rate=TUNING_RATE * optimizer.learning_rate)
    return replace(spec, epochs=max(1, round(TUNING_EPOCHS * spec.epochs)), optimizer=optimizer)


class Bench:
    """Teacher, data and training settings; equal requests are trained once.

    Args:
        teacher: the trained network.
        data: series to train on and to choose epochs by; the test part is not touched.
        training: settings of the trainings.
    """

    def __init__(self, teacher: Predictor, data: Prepared, training: TrainingSpec) -> None:
        self.teacher, self.data, self.training = teacher, data, training
        self._made: dict[CompressionRequest, Predictor] = {}

    def network(self, order: CompressionRequest) -> Predictor:
        """Return the network of a request, trained now or earlier."""
        # Orders are plain values, so equal orders are one training.
        if order not in self._made:
            start = None if order.of is None else self.network(order.of)
            self._made[order] = self.train(order, start)
        return self._made[order]

    def train(self, order: CompressionRequest, start: Predictor | None) -> Predictor:
        """Train the network of a request; `start` is its start network."""
        strategy = order.strategy([self.teacher], self.data, start)
        return fit(self.data, order.model(self.teacher.spec), self.training_of(order), strategy=strategy).predictor

    def training_of(self, order: CompressionRequest) -> TrainingSpec:
        """Return the training of a request's network."""
        return order.training(self.training)
