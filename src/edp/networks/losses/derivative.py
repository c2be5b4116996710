"""Error of the change from tick to tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from edp.networks.losses.terms import TERMS, Course, check_weight, compute_masked_mean


@TERMS.register("derivative")
@dataclass(frozen=True, kw_only=True)
class Derivative:
    """Mean square of the first difference of the error, ``(e[t+1] - e[t])^2`` with e = prediction - target.

    Attributes:
        weight: factor in the training loss.

    Raises:
        ConfigError: the weight is not positive.
    """

    span: ClassVar[int] = 2

    weight: float = 0.1

    def __post_init__(self) -> None:
        check_weight("derivative", self.weight)

    def evaluate(self, course: Course) -> Tensor:
        """Return the mean over pairs of consecutive ticks."""
        # The level cancels in the difference of prediction and target, so absolute and delta mode agree.
        error = course.predicted - course.target
        return compute_masked_mean((error[:, 1:] - error[:, :-1]).square(), course.together(2))
