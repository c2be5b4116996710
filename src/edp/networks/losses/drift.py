"""Drift of the running sum of the error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.networks.losses.terms import TERMS, Course, check_weight, compute_masked_mean


@TERMS.register("drift")
@dataclass(frozen=True, kw_only=True)
class Drift:
    """Mean square of the error's running sum since the first tick of a chunk that counts, over the root of its ticks.

    Errors that average out give their variance, a constant error b after n ticks n b^2: for rates that are integrated
    outside, where slow errors add up to drift.

    Attributes:
        weight: factor in the training loss.

    Raises:
        ConfigError: the weight is not positive.
    """

    span: ClassVar[int] = 2

    weight: float = 0.02

    def __post_init__(self) -> None:
        check_weight("drift", self.weight)

    def evaluate(self, course: Course) -> Tensor:
        """Return the mean over the ticks that count."""
        error = torch.where(course.valid[..., None, None], course.predicted - course.target, 0.0)
        # The sum of independent errors grows with the root of the ticks; the quotient keeps late ticks from dominating.
        ticks = course.valid.to(error.dtype).cumsum(dim=1).clamp(min=1.0)[..., None, None]
        return compute_masked_mean(error.cumsum(dim=1).square() / ticks, course.valid)
