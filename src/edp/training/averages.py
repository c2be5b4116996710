"""Averages of the weights over training, which are validated and stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from edp.errors import ConfigError
from edp.registry import Registry
from edp.settings.bounds import SHARE, above, between, check_bounds


class AverageSpec(Protocol):
    """Options of an average. Pure functions of the update count, so that a resumed run averages alike."""

    def step(self, update: int, updates: int) -> float:
        """Share of the way to the weights that the average goes after `update` of `updates`; 1 takes them over."""
        ...

    def rate_factor(self, factor: float, update: int, updates: int) -> float:
        """Return the fraction of the base learning rate at an update, from the schedule's fraction."""
        ...

    def may_stop(self) -> bool:
        """Return whether training may end early without losing the benefit of the average."""
        ...


AVERAGES: Registry[type] = Registry("average")


@AVERAGES.register("none")
@dataclass(frozen=True, kw_only=True)
class NoAverage:
    """The weights themselves."""

    def step(self, update: int, updates: int) -> float:
        """Take the weights over."""
        return 1.0

    def rate_factor(self, factor: float, update: int, updates: int) -> float:
        """Return the schedule's fraction."""
        return factor

    def may_stop(self) -> bool:
        """Return True: training may stop at any time."""
        return True


@AVERAGES.register("ema")
@dataclass(frozen=True, kw_only=True)
class Exponential:
    """Exponential moving average after each update; young averages move faster.

    Attributes:
        decay: share that an update keeps.

    Raises:
        ConfigError: decay outside ]0, 1[.
    """

    # 0.995: some 200 updates long.
    decay: float = 0.995

    def __post_init__(self) -> None:
        if not between(0.0, 1.0).holds(self.decay):
            raise ConfigError(f"ema: decay = {self.decay}; 0 < decay < 1 must hold (kind = 'none' averages nothing)")

    def step(self, update: int, updates: int) -> float:
        """Move the average towards the weights by ``1 - decay``, at first by ``9 / (10 + n)``."""
        # A young average would otherwise hold on to the random start.
        return 1.0 - min(self.decay, (1 + update) / (10 + update))

    def rate_factor(self, factor: float, update: int, updates: int) -> float:
        """Return the schedule's fraction."""
        return factor

    def may_stop(self) -> bool:
        """Return True: training may stop at any time."""
        return True


@AVERAGES.register("swa")
@dataclass(frozen=True, kw_only=True)
class Stochastic:
    """Stochastic weight averaging: the plain mean over the last updates, at a constant rate (thesis 3.2.4.2).

    Before, the weights themselves are validated. A training with it is not stopped early.

    Attributes:
        fraction: fraction of all updates, at the end, that are averaged.
        lr_ratio: learning rate while averaging, as a share of the base rate; 0 leaves it to the schedule.

    Raises:
        ConfigError: share outside ]0, 1], or rate outside [0, 1].
    """

    fraction: float = 0.2
    lr_ratio: float = 0.3

    def __post_init__(self) -> None:
        check_bounds("swa", self, fraction=above(0.0, 1.0), lr_ratio=SHARE)

    def _begin(self, updates: int) -> int:
        # At least one update, so that the mean exists at the end of a short training.
        return updates - max(1, round(self.fraction * updates))

    def step(self, update: int, updates: int) -> float:
        """Return the step of the mean: ``1 / n`` for the n-th averaged update."""
        return 1.0 / max(1, update - self._begin(updates))

    def rate_factor(self, factor: float, update: int, updates: int) -> float:
        """Return the constant rate during averaging."""
        return self.lr_ratio if self.lr_ratio and update > self._begin(updates) else factor

    def may_stop(self) -> bool:
        """Return whether the average is complete."""
        return False
