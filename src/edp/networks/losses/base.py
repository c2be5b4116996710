"""Inputs of a loss, the registry of main losses, and their weighted mean over the valid samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor

from edp.registry import Registry

POINT, QUANTILES, NORMAL, LAPLACE = "point", "quantiles", "normal", "laplace"


@dataclass(frozen=True, eq=False)
class Prediction:
    """Output of a network in standard deviations of the target.

    Attributes:
        center: ``(batch, time, horizon, output)``: the prediction itself, a median or a mean.
        spread: predicted uncertainty, ``(batch, time, horizon, number, output)``: empty for a point prediction; signed
            distances of the other levels from the median for quantiles; logarithm of the variance for a distribution.
        levels: levels of the quantiles in `spread`, in order.
        law: distribution of the error, ``normal`` or ``laplace``, if `spread` is a variance.
    """

    center: Tensor
    spread: Tensor
    levels: tuple[float, ...] = ()
    law: str = ""


class LossSpec(Protocol):
    """Options of a main loss."""

    outputs: ClassVar[tuple[str, ...]]
    """Names of the output kinds in `edp.networks.outputs.OUTPUTS` that this loss can train."""

    def evaluate(self, answer: Prediction, target: Tensor) -> Tensor:
        """Return the loss of each prediction, ``(batch, time, horizon, output)``.

        `target` has this shape, standardised.
        """
        ...


class Penalty(ABC):
    """Loss that depends on the error of a point prediction only."""

    outputs: ClassVar[tuple[str, ...]] = (POINT,)

    @abstractmethod
    def penalty(self, error: Tensor) -> Tensor:
        """Return the penalty of each error, same shape."""

    def evaluate(self, answer: Prediction, target: Tensor) -> Tensor:
        """Return the penalty of the prediction's error."""
        return self.penalty(answer.center - target)


LOSSES: Registry[type] = Registry("loss")


def compute_masked_loss(spec: LossSpec, answer: Prediction, target: Tensor, valid: Tensor, weights: Tensor) -> Tensor:
    """Return the mean weighted loss over the valid ticks.

    Args:
        spec: the loss.
        answer: output of the network.
        target: standardised, ``(batch, time, horizon, output)``.
        valid: ``(batch, time)``; ticks that count.
        weights: ``(horizon, output)`` or ``(output,)``.
    """
    each = (spec.evaluate(answer, target) * weights).mean(dim=(-1, -2))
    mask = valid.to(each.dtype)
    # At least one: a batch without valid ticks gives zero, not NaN, and leaves the weights as they are.
    return (each * mask).sum() / mask.sum().clamp(min=1.0)
