"""Training settings, and checks for contradictions."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

from edp.data.augment import AugmentationSpec
from edp.data.chunks import ChunkSpec
from edp.data.task import Task
from edp.errors import ConfigError
from edp.networks.activations import Identity
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead
from edp.networks.losses import LOSSES, TERMS, AdaptiveWeights, Huber, LossSpec, TermSpec
from edp.networks.losses.base import Penalty
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import ModelSpec
from edp.settings.bounds import (
    MAX_EPOCHS,
    MAX_THREADS,
    MAX_UPDATES,
    MAX_WEIGHT,
    SEED,
    above,
    check_bounds,
    check_count,
    integer,
    span,
)
from edp.training.averages import AverageSpec, Exponential
from edp.training.bagging.spec import BaggingSpec
from edp.training.optimizers import AdamW, OptimizerSpec
from edp.training.schedules import Cosine, ScheduleSpec

REFITS = ("none", "best", "whole")
MAX_POWER = 4.0
"""Of the weights of outputs: spreads of targets a thousand times apart then give weights 1e12 times apart."""
MAX_AUGMENTATIONS = 16
GRADIENT_CHUNK, GRADIENT_LANES, GRADIENT_UPDATES = 64, 16, 200
"""Ticks and lanes of an update of a committee, and updates an epoch. Nothing recurs in it, so short chunks do, and
little data have chunks enough."""


@dataclass(frozen=True, kw_only=True)
class TrainingSpec:
    """Training settings.

    Attributes:
        chunks: chunk or window regime, lengths, batch.
        augmentations: options of registered augmentations of the training data, applied in order.
        loss: a registered loss.
        terms: options of registered terms, added to the loss.
        weight_power: p of the per-output weights (eq. 3.31); 0 for standardised targets.
        horizon_decay: weight of each horizon relative to the one before it; the mean over horizons stays one.
        adaptive: weights of outputs by their running error.
        optimizer: a registered optimiser.
        schedule: a registered learning-rate schedule.
        average: a registered average of the weights, which is validated and kept.
        epochs: the longest training.
        updates: updates per epoch; 0 for one pass over the data.
        patience: epochs without a better validation score before an early stop; 0 never stops early.
        refit: train again on training and validation segments together, for short data: ``best`` for as many epochs as
            were best before, ``whole`` for all of them, to the end of the schedule, ``none`` not at all. The
            calibration of intervals stays that of the first training.
        ensemble: train a committee on folds, by rows and not by chunks; of the other settings only `loss`, `seed` and
            `threads` then count. None trains in chunks, and so does what begins with given weights or a teacher.
        clip_norm: largest global gradient norm.
        seed: root of every random choice.
        threads: CPU threads, 0 for all cores; more than one pays for wide networks on an idle machine only, and
            another count gives other bits.
        device: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        ConfigError: a value out of range.
    """

    chunks: ChunkSpec = field(default_factory=ChunkSpec)
    augmentations: tuple[AugmentationSpec, ...] = ()
    loss: LossSpec = field(default_factory=Huber)
    terms: tuple[TermSpec, ...] = ()
    weight_power: float = 0.0
    horizon_decay: float = 1.0
    adaptive: AdaptiveWeights = field(default_factory=AdaptiveWeights)
    optimizer: OptimizerSpec = field(default_factory=AdamW)
    schedule: ScheduleSpec = field(default_factory=Cosine)
    average: AverageSpec = field(default_factory=Exponential)
    epochs: int = 20
    updates: int = 0
    # Some epochs of patience: noise of the validation score alone must not end a training.
    patience: int = 8
    refit: str = "none"
    ensemble: BaggingSpec | None = None
    # Recurrent networks have rare steep gradients; the norm of 1 bounds the step that these cause.
    clip_norm: float = 1.0
    seed: int = 0
    # One thread: two were slower on small steps of a busy machine (docs/journal, two threads).
    threads: int = 1
    device: str = "auto"

    def __post_init__(self) -> None:
        check_bounds(
            "training",
            self,
            weight_power=span(-MAX_POWER, MAX_POWER),
            horizon_decay=above(0.0, 1.0),
            epochs=integer(1, MAX_EPOCHS),
            updates=integer(0, MAX_UPDATES),
            patience=integer(0, MAX_EPOCHS),
            clip_norm=above(0.0, MAX_WEIGHT),
            seed=SEED,
            threads=integer(0, MAX_THREADS),
        )
        check_count("training", "augmentations", self.augmentations, MAX_AUGMENTATIONS)
        if self.refit not in REFITS:
            raise ConfigError(f"training: refit = '{self.refit}'; {_either(REFITS)} must hold")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ConfigError(f"training: device = '{self.device}'; 'auto', 'cpu' or 'cuda' must hold")
        names = [TERMS.name_of(term) for term in self.terms]
        if len(set(names)) < len(names):
            raise ConfigError(f"training: terms {', '.join(names)}; each at most once must hold")
        seen = self.chunks.consecutive if self.chunks.regime == "window" else self.chunks.length
        for name, term in zip(names, self.terms, strict=True):
            if term.span > seen:
                raise ConfigError(
                    f"training: the term '{name}' compares {term.span} consecutive predictions, but "
                    + (
                        f"windows are drawn {seen} at a time; set chunks.consecutive = {term.span} and a batch that is "
                        "a multiple of it, or train on chunks"
                        if self.chunks.regime == "window"
                        else f"chunks have {seen} ticks; {term.span} or more must hold"
                    )
                )


def to_gradient_training(spec: TrainingSpec) -> TrainingSpec:
    """Return the settings of a gradient training in chunks that replaces a training on folds.

    Chunks and updates an epoch are those of a committee where the spec leaves its defaults; all else stays.
    """
    if spec.ensemble is None:
        return spec
    chunks = ChunkSpec(length=GRADIENT_CHUNK, batch=GRADIENT_LANES, burn_in=0)
    return replace(
        spec,
        ensemble=None,
        chunks=chunks if spec.chunks == ChunkSpec() else spec.chunks,
        updates=spec.updates or GRADIENT_UPDATES,
    )


def thread_count(spec: TrainingSpec) -> int:
    """Return the CPU threads that a training uses."""
    return spec.threads or os.cpu_count() or 1


def check_training(task: Task, model: ModelSpec, spec: TrainingSpec) -> None:
    """Refuse settings of a training that contradict the network or the task.

    Raises:
        ConfigError: every reason found.
    """
    reasons = []
    loss, output = LOSSES.name_of(spec.loss), OUTPUTS.name_of(model.output)
    if output not in spec.loss.outputs:
        fitting = [name for name, part in LOSSES.items() if output in getattr(part, "outputs", ())]
        reasons.append(
            f"the loss '{loss}' trains the output {_either(spec.loss.outputs)}, but model.output is '{output}', which "
            f"is trained by the loss {_either(fitting)}; change one of the two"
        )
    # A setting without effect is refused, since its user expects one.
    if spec.horizon_decay < 1 and len(task.horizons) == 1:
        reasons.append(
            f"horizon_decay = {spec.horizon_decay} weighs horizons against one another, but the task has one "
            f"({task.horizons[0]}); set it to 1"
        )
    if spec.adaptive.blend and len(task.targets) == 1:
        reasons.append(
            f"adaptive.blend = {spec.adaptive.blend} weighs outputs against one another, but the task has one target "
            f"('{task.targets[0]}'); set it to 0"
        )
    if spec.ensemble is not None:
        reasons += _list_bagging_conflicts(model, spec, spec.ensemble)
    if reasons:
        raise ConfigError("training: " + "; ".join(reasons))


def check_fitted_parts(model: ModelSpec, spec: TrainingSpec) -> None:
    """Raise an error for parts fitted by training on folds only, if the training starts from random weights.

    Raises:
        ConfigError: it has trees, which no gradient reaches, or limits that only such a training sets.
    """
    backbone = model.backbone
    if spec.ensemble is None and isinstance(backbone, CommitteeSpec) and backbone.clip_inputs:
        raise ConfigError(
            "training: model.backbone.clip_inputs = true, but only a training on folds sets limits (a table "
            "training.ensemble, as in the preset 'ensemble'); take one, or set clip_inputs = false"
        )
    if spec.ensemble is None and isinstance(backbone, CommitteeSpec) and backbone.trees:
        raise ConfigError(
            f"training: model.backbone.trees = {backbone.trees}, but no gradient reaches trees; train on folds (a "
            "table training.ensemble, as in the preset 'ensemble'), or set trees = 0"
        )


def _list_bagging_conflicts(model: ModelSpec, spec: TrainingSpec, bagging: BaggingSpec) -> list[str]:
    """Return the reasons against training on folds."""
    reasons = []
    if not isinstance(model.backbone, CommitteeSpec) or not isinstance(model.head, LinearHead):
        reasons.append(
            "ensemble trains model.backbone = 'committee' with model.head = 'linear'; take these, or leave it"
        )
    elif model.backbone.members % (bagging.folds * (2 if bagging.huber_delta else 1)):
        twice = "twice " if bagging.huber_delta else ""
        reasons.append(
            f"ensemble.folds = {bagging.folds} with {model.backbone.members} members; a multiple of {twice}"
            f"the folds must hold{' with ensemble.huber_delta' if twice else ''}"
        )
    parts = [
        name
        for name, present in (
            ("model.blocks", bool(model.blocks)),
            ("model.physics", model.physics is not None),
            ("model.output", OUTPUTS.name_of(model.output) != "point"),
            ("model.activation", not isinstance(model.activation, Identity)),
            ("training.terms", bool(spec.terms)),
            ("training.augmentations", bool(spec.augmentations)),
        )
        if present
    ]
    if parts:
        reasons.append(f"ensemble does not train {', '.join(parts)}; leave it out")
    if not isinstance(spec.loss, Penalty):
        fitting = [name for name, part in LOSSES.items() if issubclass(part, Penalty)]
        reasons.append(f"ensemble with the loss '{LOSSES.name_of(spec.loss)}'; {_either(fitting)} must hold")
    return reasons


def _either(names: tuple[str, ...] | list[str]) -> str:
    return " or ".join(f"'{name}'" for name in names)
