"""Correlation of predictions with targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.networks.losses.terms import TERMS, Course, check_weight

FLOOR = 1e-8  # minimum variance, in squared standard deviations: a constant signal has no correlation


@TERMS.register("correlation")
@dataclass(frozen=True, kw_only=True)
class Correlation:
    """One minus Pearson's correlation of the network's output with its target over a batch, mean over outputs.

    In delta mode both are changes from the present value. It is zero at a perfect prediction and does not notice an
    offset or a factor, so it only goes with a main loss.

    Attributes:
        weight: factor in the training loss.

    Raises:
        ConfigError: the weight is not positive.
    """

    span: ClassVar[int] = 1

    weight: float = 0.1

    def __post_init__(self) -> None:
        check_weight("correlation", self.weight)

    def evaluate(self, course: Course) -> Tensor:
        """Return the mean over horizons and outputs; outputs with a constant target in this batch count as perfect."""
        mask = course.valid[..., None, None]
        count = course.valid.sum().clamp(min=1)

        def centred(x: Tensor) -> Tensor:
            # Masked ticks may hold NaN or infinity; selecting before the sum keeps them out of the gradient as well.
            masked = torch.where(mask, x, 0.0)
            return torch.where(mask, masked - masked.sum(dim=(0, 1)) / count, 0.0)

        p, y = centred(course.predicted), centred(course.target)
        spread_p, spread_y = p.square().sum(dim=(0, 1)) / count, y.square().sum(dim=(0, 1)) / count
        # The floor inside the root bounds the gradient where a prediction stands still.
        pearson = (p * y).sum(dim=(0, 1)) / count / torch.sqrt((spread_p + FLOOR) * (spread_y + FLOOR))
        return torch.where(spread_y > FLOOR, 1.0 - pearson, 0.0).mean()
