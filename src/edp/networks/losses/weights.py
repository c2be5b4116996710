"""Weights of outputs and horizons: fixed, falling with the horizon, or led by the running error."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from edp.settings.bounds import MAX_WEIGHT, SHARE, above, below, check_bounds


def output_weights(sigma: Tensor, power: float) -> Tensor:
    """Return weights ``w_i`` proportional to ``1 / sigma_i^power`` with mean one (eq. 3.31).

    The sum is the number of outputs.

    Args:
        sigma: standard deviation of each target in SI units, ``(..., output)``.
        power: p; 0 weighs all outputs alike, right where targets are standardised already.
    """
    # Double precision: powers of small standard deviations overflow float32 early.
    weights = sigma.double().pow(-power)
    return (weights / weights.mean(dim=-1, keepdim=True)).to(sigma.dtype)


def horizon_weights(horizons: int, decay: float) -> Tensor:
    """Return the weights ``(horizon, 1)`` proportional to ``decay^i`` for the i-th horizon, i from 0, with mean one."""
    weights = torch.tensor([decay**horizon_index for horizon_index in range(horizons)], dtype=torch.float64)
    return (weights / weights.mean()).float().unsqueeze(-1)


@dataclass(frozen=True, kw_only=True)
class AdaptiveWeights:
    """Output weights inverse to the running error, so that all outputs contribute similarly to the loss.

    With r_i the running mean absolute error of output i in standard deviations and ``a_i`` proportional to ``1 / r_i``,
    cut where it exceeds `max_ratio` times the smallest and with mean one, output i is weighted by
    ``1 - blend + blend a_i``, in addition to its fixed weight. Each horizon has its own.

    Attributes:
        blend: share of the adaptive part; 0 leaves the fixed weights alone.
        max_ratio: largest ratio of two adaptive weights.
        decay: share of the running error that an update keeps.

    Raises:
        ConfigError: a value out of range.
    """

    blend: float = 0.0
    max_ratio: float = 3.0
    decay: float = 0.99

    def __post_init__(self) -> None:
        check_bounds("adaptive", self, blend=SHARE, max_ratio=above(1.0, MAX_WEIGHT), decay=below(0.0, 1.0))

    def weights(self, running: Tensor) -> Tensor:
        """Return the weights ``(horizon, output)`` from the running errors, same shape."""
        # A running error of zero, before the first batch or on perfect outputs, must not divide.
        inverse = running.clamp(min=1e-9).reciprocal()
        cut = torch.minimum(inverse, self.max_ratio * inverse.amin(dim=-1, keepdim=True))
        return 1.0 - self.blend + self.blend * cut / cut.mean(dim=-1, keepdim=True)

    def follow(self, running: Tensor, error: Tensor, valid: Tensor) -> Tensor:
        """Return the running errors after a batch with errors ``(batch, time, horizon, output)``."""
        count = valid.sum()
        mean = torch.where(valid[..., None, None], error.abs(), 0.0).sum(dim=(0, 1)) / count.clamp(min=1)
        # A batch without valid ticks must not pull the running error towards zero.
        return torch.where(count > 0, self.decay * running + (1.0 - self.decay) * mean, running)
