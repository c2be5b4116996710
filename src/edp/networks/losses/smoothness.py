"""Smoothness of consecutive predictions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from edp.networks.losses.terms import TERMS, Course, check_weight, compute_masked_mean


@TERMS.register("smoothness")
@dataclass(frozen=True, kw_only=True)
class Smoothness:
    """Mean square of the second difference ``p[t+1] - 2 p[t] + p[t-1]`` of predicted values p (thesis 3.2.4.3).

    It is zero where predictions follow a straight line, and does not look at the targets.

    Attributes:
        weight: factor in the training loss.

    Raises:
        ConfigError: the weight is not positive.
    """

    span: ClassVar[int] = 3

    weight: float = 0.05

    def __post_init__(self) -> None:
        check_weight("smoothness", self.weight)

    def evaluate(self, course: Course) -> Tensor:
        """Return the mean over triplets of consecutive ticks."""
        # The level is added back: in delta mode the increments alone would be smoothed, not the predicted velocity.
        value = course.predicted + course.level
        bend = value[:, 2:] - 2.0 * value[:, 1:-1] + value[:, :-2]
        return compute_masked_mean(bend.square(), course.together(3))
