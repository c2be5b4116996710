"""Likelihood of a prediction that states its own uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.networks.losses.base import LAPLACE, LOSSES, NORMAL, Prediction
from edp.settings.bounds import SHARE, check_bounds


@LOSSES.register("heteroscedastic")
@dataclass(frozen=True, kw_only=True)
class Heteroscedastic:
    """Negative log-likelihood of the error under the law of the model's output, with s = log variance.

    Normal: ``(e^2 exp(-s) + s) / 2``. Laplace: ``sqrt(2) |e| exp(-s / 2) + s / 2``. Constants are left out. With
    `beta` each term is weighted by ``variance^beta``, through which no gradient flows (Seitzer et al. 2022, arXiv
    2203.09168): the likelihood alone neglects samples that it has declared uncertain.

    Attributes:
        beta: 0 is the likelihood itself; 1 trains the mean of a normal law as the squared error does.

    Raises:
        ConfigError: beta outside [0, 1].
    """

    outputs: ClassVar[tuple[str, ...]] = (NORMAL, LAPLACE)

    beta: float = 0.5

    def __post_init__(self) -> None:
        check_bounds("heteroscedastic", self, beta=SHARE)

    def evaluate(self, answer: Prediction, target: Tensor) -> Tensor:
        """Return the likelihood term of each prediction."""
        error, log_variance = answer.center - target, answer.spread[..., 0, :]
        if answer.law == LAPLACE:
            # sqrt(2) turns the standard deviation into the scale of a Laplace law.
            each = math.sqrt(2.0) * error.abs() * torch.exp(-0.5 * log_variance) + 0.5 * log_variance
        else:
            each = 0.5 * (error.square() * torch.exp(-log_variance) + log_variance)
        # The detached factor damps the learning of the variance, which otherwise hides large errors (Seitzer et al.
        # 2022).
        return each * torch.exp(self.beta * log_variance.detach()) if self.beta else each
