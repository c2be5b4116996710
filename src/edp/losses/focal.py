"""Focal loss: large errors weigh more."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from edp.errors import ConfigError
from edp.losses.base import LOSSES, Penalty
from edp.losses.huber import huber

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
        if not 0 <= self.gamma <= 4 or not self.delta > 0:
            raise ConfigError(
                f"focal: gamma = {self.gamma}, delta = {self.delta}; 0 <= gamma <= 4, delta > 0 must hold"
            )

    def penalty(self, error: Tensor) -> Tensor:
        """``|e|^gamma`` times the Huber penalty."""
        return error.abs().clamp(min=TINY).pow(self.gamma) * huber(error, self.delta)
