"""Losses on standardised errors: one registration each, weighted per output (thesis 3.2.2.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from edp.errors import ConfigError
from edp.registry import Registry


class LossSpec(Protocol):
    """Options of a loss."""

    def penalty(self, error: Tensor) -> Tensor:
        """Penalty of each error, same shape."""
        ...


LOSSES: Registry[type] = Registry("loss")


@LOSSES.register("huber")
@dataclass(frozen=True, kw_only=True)
class Huber:
    """Quadratic up to `delta`, linear beyond (eq. 3.30).

    Attributes:
        delta: threshold in standard deviations of the target.

    Raises:
        ConfigError: delta is not positive.
    """

    delta: float = 1.5

    def __post_init__(self) -> None:
        if not self.delta > 0:
            raise ConfigError(f"huber: delta = {self.delta}; delta > 0 must hold")

    def penalty(self, error: Tensor) -> Tensor:
        """``e^2 / 2`` inside, ``delta (|e| - delta / 2)`` outside."""
        size = error.abs()
        inside = torch.clamp(size, max=self.delta)
        return inside * (size - 0.5 * inside)


@LOSSES.register("mse")
@dataclass(frozen=True, kw_only=True)
class MeanSquared:
    """Squared error (eq. 3.29)."""

    def penalty(self, error: Tensor) -> Tensor:
        """``e^2``."""
        return error.square()


def output_weights(sigma: Tensor, power: float) -> Tensor:
    """Weights ``w_i`` proportional to ``1 / sigma_i^power`` with mean one (eq. 3.31; the sum is the output count).

    Args:
        sigma: standard deviation of each target in SI units, ``(..., output)``.
        power: p; 0 weighs all outputs alike, right where targets are standardised already.
    """
    weights = sigma.double().pow(-power)
    return (weights / weights.mean(dim=-1, keepdim=True)).to(sigma.dtype)


def masked_loss(spec: LossSpec, prediction: Tensor, target: Tensor, valid: Tensor, weights: Tensor) -> Tensor:
    """Mean weighted penalty over the valid ticks.

    Args:
        spec: the loss.
        prediction: standardised, ``(batch, time, horizon, output)``.
        target: likewise.
        valid: ``(batch, time)``; ticks that count.
        weights: ``(horizon, output)`` or ``(output,)``.
    """
    penalty = (spec.penalty(prediction - target) * weights).mean(dim=(-1, -2))
    mask = valid.to(penalty.dtype)
    return (penalty * mask).sum() / mask.sum().clamp(min=1.0)
