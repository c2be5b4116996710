"""Pinball loss of quantiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.networks.losses.base import LOSSES, QUANTILES, Prediction


@LOSSES.register("quantile")
@dataclass(frozen=True, kw_only=True)
class Quantile:
    """Pinball loss, mean over the levels of the model's output: ``2 max(p u, (p - 1) u)``, u = target - quantile.

    The factor 2 makes the contribution of the median equal to the absolute error.
    """

    outputs: ClassVar[tuple[str, ...]] = (QUANTILES,)

    def evaluate(self, answer: Prediction, target: Tensor) -> Tensor:
        """Return the mean pinball loss of each prediction's quantiles."""
        below = target - answer.center
        # The median's pinball loss times two is the absolute error, which keeps the scale of the point losses.
        total = below.abs()
        beyond = below.unsqueeze(-2) - answer.spread
        for level_index, level in enumerate(answer.levels):
            u = beyond[..., level_index, :]
            total = total + 2.0 * torch.maximum(level * u, (level - 1.0) * u)
        return total / (1 + len(answer.levels))
