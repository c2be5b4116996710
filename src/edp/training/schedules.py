"""Learning-rate schedules as pure functions of progress, plus one that watches the validation error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from edp.registry import Registry
from edp.settings.bounds import MAX_EPOCHS, SHARE, below, check_bounds, integer


@dataclass
class ScheduleState:
    """State of a schedule between epochs; plain values, stored in checkpoints."""

    factor: float = 1.0
    best: float = math.inf
    waited: int = 0


class ScheduleSpec(Protocol):
    """Options of a schedule."""

    def rate_factor(self, progress: float, state: ScheduleState) -> float:
        """Share of the base learning rate at `progress` in [0, 1] of the run."""
        ...

    def observe(self, validation: float, state: ScheduleState) -> None:
        """Take notice of the validation score after an epoch."""
        ...


SCHEDULES: Registry[type] = Registry("schedule")


def _ramp(progress: float, share: float) -> float:
    # The small constant gives the first update a rate above zero.
    return min(1.0, (progress + 1e-3) / share) if share > 0 else 1.0


@SCHEDULES.register("constant")
@dataclass(frozen=True, kw_only=True)
class Constant:
    """The base rate throughout, after a warm-up.

    Attributes:
        warmup: share of the run in which the rate rises from zero.
    """

    warmup: float = 0.0

    def __post_init__(self) -> None:
        check_bounds("schedule", self, warmup=SHARE)

    def rate_factor(self, progress: float, state: ScheduleState) -> float:
        return _ramp(progress, self.warmup)

    def observe(self, validation: float, state: ScheduleState) -> None:
        """Ignore the validation error."""


@SCHEDULES.register("cosine")
@dataclass(frozen=True, kw_only=True)
class Cosine:
    """Half a cosine from the base rate to the fraction `min_lr_ratio`, after a warm-up.

    Attributes:
        warmup: share of the run in which the rate rises from zero.
        min_lr_ratio: share of the base rate at the end.
    """

    # A short warm-up: moments of the optimiser are unreliable in the first updates.
    warmup: float = 0.03
    min_lr_ratio: float = 0.01

    def __post_init__(self) -> None:
        check_bounds("schedule", self, warmup=SHARE, min_lr_ratio=SHARE)

    def rate_factor(self, progress: float, state: ScheduleState) -> float:
        if progress < self.warmup:
            return _ramp(progress, self.warmup)
        # The guard serves a warm-up of the whole run, where the cosine has no length.
        done = (progress - self.warmup) / max(1e-9, 1.0 - self.warmup)
        return self.min_lr_ratio + (1.0 - self.min_lr_ratio) * 0.5 * (1.0 + math.cos(math.pi * min(1.0, done)))

    def observe(self, validation: float, state: ScheduleState) -> None:
        """Ignore the validation error."""


@SCHEDULES.register("one_cycle")
@dataclass(frozen=True, kw_only=True)
class OneCycle:
    """Learning rate that rises along a cosine, then falls along a cosine.

    It rises from the fraction `start_lr_ratio` to the base rate over the fraction `warmup` of the run, then falls to
    `min_lr_ratio`.

    Attributes:
        warmup: share of the run that rises.
        start_lr_ratio: share of the base rate at the beginning.
        min_lr_ratio: share of the base rate at the end.
    """

    warmup: float = 0.3
    start_lr_ratio: float = 0.04
    min_lr_ratio: float = 1e-3

    def __post_init__(self) -> None:
        check_bounds("schedule", self, warmup=SHARE, start_lr_ratio=SHARE, min_lr_ratio=SHARE)

    def rate_factor(self, progress: float, state: ScheduleState) -> float:
        if progress < self.warmup:
            return _interpolate_cosine(self.start_lr_ratio, 1.0, progress / self.warmup)
        return _interpolate_cosine(
            1.0, self.min_lr_ratio, min(1.0, (progress - self.warmup) / max(1e-9, 1.0 - self.warmup))
        )

    def observe(self, validation: float, state: ScheduleState) -> None:
        """Ignore the validation error."""


@SCHEDULES.register("plateau")
@dataclass(frozen=True, kw_only=True)
class Plateau:
    """Multiply the rate by `factor` when the validation score has not improved for `patience` epochs.

    Attributes:
        factor: factor of each reduction.
        patience: epochs without improvement before a reduction.
        threshold: relative improvement that counts.
        min_lr_ratio: smallest share of the base rate.
    """

    factor: float = 0.5
    patience: int = 5
    threshold: float = 1e-4
    min_lr_ratio: float = 1e-3

    def __post_init__(self) -> None:
        check_bounds(
            "schedule",
            self,
            factor=SHARE,
            patience=integer(0, MAX_EPOCHS),
            threshold=below(0.0, 1.0),
            min_lr_ratio=SHARE,
        )

    def rate_factor(self, progress: float, state: ScheduleState) -> float:
        return state.factor

    def observe(self, validation: float, state: ScheduleState) -> None:
        """Count epochs without improvement."""
        # A relative threshold, since the unit of the score depends on the targets.
        if validation < state.best * (1.0 - self.threshold):
            state.best, state.waited = validation, 0
            return
        state.waited += 1
        if state.waited > self.patience:  # epochs without gain, then one step down
            state.factor, state.waited = max(self.min_lr_ratio, state.factor * self.factor), 0


def _interpolate_cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) * 0.5 * (1.0 + math.cos(math.pi * share))
