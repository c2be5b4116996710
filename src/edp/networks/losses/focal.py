"""Focal loss: large errors weigh more."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from edp.networks.losses.base import LOSSES, Penalty
from edp.networks.losses.huber import huber
from edp.settings.bounds import WEIGHT, check_bounds, span

TINY = 1e-12  # the derivative of a power below one has no limit at zero


@LOSSES.register("focal")
@dataclass(frozen=True, kw_only=True)
class Focal(Penalty):
    """Huber loss weighted by the size of the error: ``|e|^gamma * huber(e)``.

    Attributes:
        gamma: power of the weight; 0 is the Huber loss.
        delta: threshold of the Huber loss in standard deviations of the target.

    Raises:
        ConfigError: gamma outside [0, 4], or delta is not positive.
    """

    gamma: float = 2.0
    delta: float = 1.5

    def __post_init__(self) -> None:
        check_bounds("focal", self, gamma=span(0.0, 4.0), delta=WEIGHT)

    def penalty(self, error: Tensor) -> Tensor:
        """Return ``|e|^gamma`` times the Huber penalty."""
        return error.abs().clamp(min=TINY).pow(self.gamma) * huber(error, self.delta)
