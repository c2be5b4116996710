"""Huber loss."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from edp.networks.losses.base import LOSSES, Penalty
from edp.settings.bounds import WEIGHT, check_bounds


@LOSSES.register("huber")
@dataclass(frozen=True, kw_only=True)
class Huber(Penalty):
    """Quadratic up to `delta`, linear beyond (eq. 3.30).

    Attributes:
        delta: threshold in standard deviations of the target.

    Raises:
        ConfigError: delta is not positive.
    """

    delta: float = 1.5

    def __post_init__(self) -> None:
        check_bounds("huber", self, delta=WEIGHT)

    def penalty(self, error: Tensor) -> Tensor:
        """Return ``e^2 / 2`` inside, ``delta (|e| - delta / 2)`` outside."""
        return huber(error, self.delta)


def huber(error: Tensor, delta: float) -> Tensor:
    """Return the Huber penalty of each error."""
    size = error.abs()
    # One expression for both branches: no selection, and a continuous gradient at `delta`.
    inside = torch.clamp(size, max=delta)
    return inside * (size - 0.5 * inside)
