"""Optimisers: one registration each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import nn

from edp.errors import ConfigError
from edp.registry import Registry


class OptimizerSpec(Protocol):
    """Options of an optimiser."""

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser on these parameters."""
        ...


OPTIMIZERS: Registry[type] = Registry("optimizer")


@OPTIMIZERS.register("adamw")
@dataclass(frozen=True, kw_only=True)
class AdamW:
    """Adam with decoupled weight decay (thesis 3.2.4.2); decay acts on matrices only, not on biases and gains.

    Attributes:
        learning_rate: base rate.
        weight_decay: lambda.
        beta1: decay of the mean of gradients.
        beta2: decay of the mean of squares.
    """

    learning_rate: float = 4e-3
    weight_decay: float = 1e-4
    beta1: float = 0.9
    beta2: float = 0.99

    def __post_init__(self) -> None:
        if not self.learning_rate > 0 or self.weight_decay < 0:
            raise ConfigError(
                f"adamw: learning_rate = {self.learning_rate}, weight_decay = {self.weight_decay}; "
                "learning_rate > 0 and weight_decay >= 0 must hold"
            )

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser, with biases and gains free of decay."""
        matrices, vectors = _decaying(named)
        groups = [{"params": matrices, "weight_decay": self.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        return torch.optim.AdamW(groups, lr=self.learning_rate, betas=(self.beta1, self.beta2), fused=True)


@OPTIMIZERS.register("sgd")
@dataclass(frozen=True, kw_only=True)
class Sgd:
    """Plain gradient descent: what a network was meta-learned for.

    Attributes:
        learning_rate: base rate.
    """

    learning_rate: float = 0.05

    def __post_init__(self) -> None:
        if not self.learning_rate > 0:
            raise ConfigError(f"sgd: learning_rate = {self.learning_rate}; learning_rate > 0 must hold")

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser on all parameters."""
        return torch.optim.SGD([parameter for _, parameter in named], lr=self.learning_rate)


@OPTIMIZERS.register("discriminative")
@dataclass(frozen=True, kw_only=True)
class Discriminative:
    """AdamW with a learning rate for each part of the network (thesis 3.4.4.2); decay acts on matrices only.

    Attributes:
        rates: pairs of a part, as the beginning of its parameters' names, and its rate; the first that fits counts.
        learning_rate: of all other parameters.
        weight_decay: lambda.
        beta1: decay of the mean of gradients.
        beta2: decay of the mean of squares.
    """

    rates: tuple[tuple[str, float], ...] = (("backbone", 1e-5),)
    learning_rate: float = 3e-4
    weight_decay: float = 1e-4
    beta1: float = 0.9
    beta2: float = 0.999

    def __post_init__(self) -> None:
        rates = [self.learning_rate, *(rate for _, rate in self.rates)]
        if not min(rates) > 0 or self.weight_decay < 0:
            raise ConfigError(
                f"discriminative: learning_rate = {self.learning_rate}, rates = {list(map(list, self.rates))}, "
                f"weight_decay = {self.weight_decay}; rates > 0 and weight_decay >= 0 must hold"
            )

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser; the first group has `learning_rate`, where any parameter has it."""
        by_rate: dict[float, list[tuple[str, nn.Parameter]]] = {self.learning_rate: []}
        for name, parameter in named:
            by_rate.setdefault(self._rate(name), []).append((name, parameter))
        groups = [
            {"params": some, "weight_decay": decay, "lr": rate}
            for rate, held in by_rate.items()
            for some, decay in zip(_decaying(held), (self.weight_decay, 0.0), strict=True)
            if some
        ]
        return torch.optim.AdamW(groups, lr=self.learning_rate, betas=(self.beta1, self.beta2), fused=True)

    def _rate(self, name: str) -> float:
        return next((rate for part, rate in self.rates if f"{name}.".startswith(f"{part}.")), self.learning_rate)


@OPTIMIZERS.register("soap")
@dataclass(frozen=True, kw_only=True)
class Soap:
    """Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al. 2024, arXiv 2409.11321).

    On networks of this size a step costs little more than AdamW's and the error falls several times faster per
    processor second; see docs/findings.md.

    Attributes:
        learning_rate: base rate.
        weight_decay: lambda, decoupled.
        beta1: decay of the mean of gradients.
        beta2: decay of the second moments.
        refresh: updates between refreshes of the eigenbasis.
    """

    learning_rate: float = 6e-3
    weight_decay: float = 1e-4
    beta1: float = 0.95
    beta2: float = 0.95
    refresh: int = 10

    def __post_init__(self) -> None:
        if not self.learning_rate > 0 or self.weight_decay < 0 or self.refresh < 1:
            raise ConfigError(
                f"soap: learning_rate = {self.learning_rate}, weight_decay = {self.weight_decay}, refresh = "
                f"{self.refresh}; learning_rate > 0, weight_decay >= 0 and refresh >= 1 must hold"
            )

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser on all parameters."""
        from pytorch_optimizer import SOAP  # deferred: only this optimiser needs the library

        return SOAP(
            [parameter for _, parameter in named],
            lr=self.learning_rate,
            betas=(self.beta1, self.beta2),
            weight_decay=self.weight_decay,
            precondition_frequency=self.refresh,
        )


def _decaying(named: Iterable[tuple[str, nn.Parameter]]) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Matrices, on which decay acts, and biases and gains, on which it does not."""
    matrices: list[nn.Parameter] = []
    vectors: list[nn.Parameter] = []
    for name, parameter in named:
        (matrices if parameter.ndim > 1 and "bias" not in name else vectors).append(parameter)
    return matrices, vectors
