"""Additional terms of the training objective: their inputs and their registry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor

from edp.errors import ConfigError
from edp.registry import Registry
from edp.settings.bounds import WEIGHT, shown


@dataclass(frozen=True, eq=False)
class Course:
    """Consecutive predictions and their targets, in standard deviations of the target.

    Attributes:
        predicted: ``(stream, time, horizon, output)``, as the network's standardised output.
        target: targets, same shape and unit.
        level: reference value of predictions and targets, ``(stream, time, 1 or horizon, output)``: the present value
            in delta mode, zero in absolute mode. ``predicted + level`` is the predicted value itself.
        valid: ``(stream, time)``; ticks that count.
    """

    predicted: Tensor
    target: Tensor
    level: Tensor
    valid: Tensor

    def together(self, ticks: int) -> Tensor:
        """Return ``(stream, time - ticks + 1)``: where `ticks` consecutive ones all count."""
        last = self.valid.shape[1] - ticks + 1
        whole = self.valid[:, :last]
        for tick in range(1, ticks):
            whole = whole & self.valid[:, tick : last + tick]
        return whole


class TermSpec(Protocol):
    """Options of a term."""

    weight: float
    span: ClassVar[int]
    """Number of consecutive predictions that the term compares."""

    def evaluate(self, course: Course) -> Tensor:
        """Return the unweighted term, a mean over the compared elements; zero without compared elements."""
        ...


TERMS: Registry[type] = Registry("term")


def check_weight(name: str, weight: float) -> None:
    """Raise ConfigError for a weight without effect, or for a weight that rewards the penalised quantity.

    Raises:
        ConfigError: the weight is not positive.
    """
    if not WEIGHT.holds(weight):
        raise ConfigError(
            f"{name}: weight = {shown(weight)}; {WEIGHT.rule('weight')} must hold (leave the term out to do without it)"
        )


def compute_masked_mean(each: Tensor, valid: Tensor) -> Tensor:
    """Return mean over horizons and outputs, then over the ticks that count; ``(stream, time, horizon, output)``."""
    mask = valid.to(each.dtype)
    return (each.mean(dim=(-1, -2)) * mask).sum() / mask.sum().clamp(min=1.0)
