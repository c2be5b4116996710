"""Distillation: training on measured targets and on the outputs of larger networks for the same samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import ConfigError, DataError
from edp.networks.losses import Huber, LossSpec, Prediction, compute_masked_loss
from edp.networks.losses.base import POINT
from edp.networks.predictor import Predictor
from edp.networks.running import stream_hidden, stream_predictions
from edp.settings.bounds import MAX_UNITS, MAX_WEIGHT, WEIGHT, below, check_bounds, integer, span
from edp.training.compression.hints import Components, hint_error
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec
from edp.training.strategy import BatchContext
from edp.training.warm_start import check_same_ends, continue_from


@dataclass(frozen=True, kw_only=True)
class SoftmaxDivergence:
    """The literal form of eq. 2.23: ``T^2 KL(softmax(teacher / T) || softmax(student / T))`` over the outputs.

    Predictions are no logits. The softmax over the outputs of a horizon forgets what they have in common: a student
    that is wrong by the same amount everywhere has no loss. It is here for comparison; the truth has to hold the level.

    Attributes:
        temperature: T, in standard deviations of the targets.

    Raises:
        ConfigError: temperature is not positive.
    """

    outputs: ClassVar[tuple[str, ...]] = (POINT,)

    temperature: float = 2.0

    def __post_init__(self) -> None:
        check_bounds("softmax divergence", self, temperature=WEIGHT)

    def evaluate(self, answer: Prediction, target: Tensor) -> Tensor:
        """Return the terms of the divergence times the number of outputs, so that their mean is the divergence."""
        student = torch.log_softmax(answer.center / self.temperature, dim=-1)
        teacher = torch.log_softmax(target / self.temperature, dim=-1)
        scale = self.temperature**2 * target.shape[-1]
        # T^2 keeps the gradient's size independent of the temperature (Hinton et al. 2015).
        return scale * teacher.exp() * (teacher - student)


@dataclass(frozen=True, kw_only=True)
class DistillationSpec:
    """The dual objective (eq. 2.23): ``truth * hard + (1 - truth) * soft + hint * hidden``.

    Attributes:
        target_weight: alpha, weight of the truth; 0 learns from the teachers alone.
        distillation_loss: loss between student and teachers: a loss of point predictions, or `SoftmaxDivergence`.
        hint_weight: weight of the hidden-feature hint; 0 for none.
        components: principal components of the teachers' hidden features that the hint compares.

    Raises:
        ConfigError: a value out of range.
    """

    target_weight: float = 0.5
    distillation_loss: LossSpec = field(default_factory=Huber)
    hint_weight: float = 0.0
    components: int = 16

    def __post_init__(self) -> None:
        if not below(0.0, 1.0).holds(self.target_weight):
            raise ConfigError(
                f"distillation: target_weight = {self.target_weight}; expected 0 <= target_weight < 1 (with 1 there is "
                "no teacher: train)"
            )
        if POINT not in self.distillation_loss.outputs:
            raise ConfigError(
                f"distillation: distillation_loss = {type(self.distillation_loss).__name__}, a loss of outputs "
                f"{', '.join(self.distillation_loss.outputs)}; a loss of point "
                "predictions is expected, since teachers predict one number per target"
            )
        check_bounds("distillation", self, hint_weight=span(0.0, MAX_WEIGHT), components=integer(1, MAX_UNITS))


class Distillation:
    """Distillation: teacher predictions of each tick are computed once, as a stream from the start of its recording.

    Several teachers say the mean of their predictions in SI units. They may differ from the student and from one
    another in everything but inputs, targets, horizons and rate. Where an augmentation changes the inputs, the student
    sees the changed ones and learns what the teachers said of the recorded ones.

    Args:
        teachers: trained networks.
        spec: the objective.
        further: series without truth, see `edp.data.unlabelled`; the student learns what the teachers say of them.
        start: a network of the student's own specs to begin with, for example a pruned one.

    Raises:
        ConfigError: no teacher, or teachers that read or predict different things.
    """

    def __init__(
        self,
        teachers: Sequence[Predictor],
        spec: DistillationSpec | None = None,
        further: Sequence[Series] = (),
        start: Predictor | None = None,
    ) -> None:
        if not teachers:
            raise ConfigError("distillation: no teacher; give at least one trained network")
        self.teachers, self.spec, self.further, self.start = list(teachers), spec or DistillationSpec(), further, start
        for number, teacher in enumerate(self.teachers[1:], start=2):
            check_same_ends(teacher.task, self.teachers[0].task, f"teacher {number}", "teacher 1")
        task = self.teachers[0].task
        self.said = len(task.horizons) * len(task.targets)  # numbers of one teacher prediction
        self.components: Components | None = None

    def series(self, task: Task, own_series: Sequence[Series]) -> list[Series]:
        """Return the series with teacher targets.

        A mark whether there is truth, predictions in SI units, hidden components.
        """
        check_same_ends(task, self.teachers[0].task, "the student", "the teacher")
        if self.spec.hint_weight and self.components is None:
            self.components = Components.fitted(
                (self._collect_hidden(part) for part in own_series), self.spec.components
            )
        marked = [(part, True) for part in own_series] + [(part, False) for part in self.further]
        return [self._add_teacher_outputs(part, truth) for part, truth in marked]

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        """Copy the weights and scaling of the start, if there is one; refuse a hint for too small batches."""
        if self.spec.hint_weight:
            chunks = spec.chunks
            ticks = chunks.batch * (chunks.length if chunks.regime == "chunk" else 1)
            width = int(net.forward_features(*_one_tick(net))[2].shape[-1])
            # The hint solves a regression in each batch: fewer than four ticks a feature would fit noise.
            if ticks < 4 * width:
                raise ConfigError(
                    f"distillation: a batch has {ticks} ticks with a loss, too few to compare {width} hidden features "
                    f"with the teachers' (hint_weight = {self.spec.hint_weight}); {4 * width} or more must "
                    "hold: take larger batches or hint_weight = 0"
                )
        if self.start is None:
            return False
        continue_from(net, self.start)
        return True

    def loss(self, objective: Objective, batch_context: BatchContext) -> Tensor:
        """Return the combined loss of a batch; samples without targets count for the teachers only."""
        spec, strategy_columns = self.spec, batch_context.strategy_columns
        # The mark is a number among the targets; half is its threshold.
        labelled = batch_context.valid & (strategy_columns[..., 0] > 0.5)
        teacher_predictions = strategy_columns[..., 1 : 1 + self.said].unflatten(-1, batch_context.future.shape[2:])
        target = objective.code.encode(teacher_predictions, batch_context.features)
        loss = (1.0 - spec.target_weight) * compute_masked_loss(
            spec.distillation_loss, batch_context.answer, target, batch_context.valid, objective.weights
        )
        if spec.target_weight:
            loss = loss + spec.target_weight * objective.evaluate(
                batch_context.answer, batch_context.future, batch_context.features, labelled
            )
        if spec.hint_weight:
            loss = loss + spec.hint_weight * hint_error(
                batch_context.hidden, strategy_columns[..., 1 + self.said :], batch_context.valid
            )
        return loss

    def end(self, net: Predictor) -> None:
        """End the distillation, which has changed only weights."""

    def _add_teacher_outputs(self, part: Series, truth: bool) -> Series:
        answers = [stream_predictions(teacher, [part])[0] for teacher in self.teachers]
        # The mean of teachers in double precision, so that their number does not change the last bit of the target.
        mean = np.mean(np.stack(answers), axis=0, dtype=np.float64).reshape(part.samples, -1)
        if not np.isfinite(mean).all():
            raise DataError(
                f"distillation: a teacher's prediction for '{part.name}' is not finite; look at the recording with "
                "edp data check"
            )
        columns = [np.full((part.samples, 1), truth), mean]
        if self.components is not None:
            columns.append(self.components.project(self._collect_hidden(part)))
        # What stands in the place of targets without truth may be no number, and NaN times a mask of zero is NaN.
        targets = part.targets if truth else np.zeros_like(part.targets)
        return replace(part, targets=targets, strategy_columns=np.concatenate(columns, axis=1).astype(np.float32))

    def _collect_hidden(self, part: Series) -> NDArray[np.float32]:
        # Side by side: hidden spaces of several teachers have no common axes to average over.
        """Return the hidden features of all teachers side by side, ``(time, width)``."""
        return np.concatenate([stream_hidden(teacher, [part])[0] for teacher in self.teachers], axis=1)


def _one_tick(net: Predictor) -> tuple[Tensor, object]:
    x = torch.zeros(1, 1, len(net.task.inputs))
    return x, net.initial_state(1, x)
