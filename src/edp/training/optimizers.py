"""Optimisers: one registration each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import nn

from edp.errors import ConfigError
from edp.registry import Registry
from edp.settings.bounds import DECAY, MAX_NAMES, MAX_UPDATES, RATE, below, check_bounds, check_count, integer, shown
from edp.training.eager import EagerAdamW, EagerSgd


class OptimizerSpec(Protocol):
    """Options of an optimiser."""

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """Create the optimiser of these parameters."""
        ...

    def remembers(self, shape: Sequence[int]) -> int:
        """Return the number of state values for a parameter of this shape."""
        ...


OPTIMIZERS: Registry[type] = Registry("optimizer")
BETA = below(0.0, 1.0)
"""Decays of running means; at 1 a mean never moves from zero."""


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
    # A beta2 of 0.99 averages over some 100 updates; a run of some hundred updates would not outlive 0.999.
    weight_decay: float = 1e-4
    beta1: float = 0.9
    beta2: float = 0.99

    def __post_init__(self) -> None:
        check_bounds("adamw", self, learning_rate=RATE, weight_decay=DECAY, beta1=BETA, beta2=BETA)

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """Create the optimiser, without weight decay for biases and gains."""
        matrices, vectors = _decaying(named)
        groups = [{"params": matrices, "weight_decay": self.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        # Fused: one pass over the memory instead of one an operation; small networks gain most.
        return EagerAdamW(groups, lr=self.learning_rate, betas=(self.beta1, self.beta2), fused=True)

    def remembers(self, shape: Sequence[int]) -> int:
        """Return two means."""
        return 2 * math.prod(shape)


@OPTIMIZERS.register("sgd")
@dataclass(frozen=True, kw_only=True)
class Sgd:
    """Plain gradient descent, for which a network was meta-learned.

    Attributes:
        learning_rate: base rate.
    """

    learning_rate: float = 0.05

    def __post_init__(self) -> None:
        check_bounds("sgd", self, learning_rate=RATE)

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """Create the optimiser of all parameters."""
        return EagerSgd([parameter for _, parameter in named], lr=self.learning_rate)

    def remembers(self, shape: Sequence[int]) -> int:
        """Return an empty state."""
        return 0


@OPTIMIZERS.register("discriminative")
@dataclass(frozen=True, kw_only=True)
class Discriminative:
    """AdamW with a learning rate for each part of the network (thesis 3.4.4.2); decay acts on matrices only.

    Attributes:
        rates: pairs of a part, as the beginning of its parameters' names, and its rate; the first that fits counts.
        learning_rate: learning rate of all other parameters.
        weight_decay: lambda.
        beta1: decay of the mean of gradients.
        beta2: decay of the mean of squares.
    """

    # The rate of the thesis's Table 3.1 for the backbone: it keeps what the source taught.
    rates: tuple[tuple[str, float], ...] = (("backbone", 1e-5),)
    learning_rate: float = 3e-4
    weight_decay: float = 1e-4
    beta1: float = 0.9
    beta2: float = 0.999

    def __post_init__(self) -> None:
        check_bounds("discriminative", self, learning_rate=RATE, weight_decay=DECAY, beta1=BETA, beta2=BETA)
        check_count("discriminative", "rates", self.rates, MAX_NAMES)
        if not all(RATE.holds(rate) for _, rate in self.rates):
            raise ConfigError(f"discriminative: rates = {shown(self.rates)}; {RATE.rule('rate')} must hold")

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """Create the optimiser; the first group has `learning_rate`, if any parameter has it."""
        by_rate: dict[float, list[tuple[str, nn.Parameter]]] = {self.learning_rate: []}
        for name, parameter in named:
            by_rate.setdefault(self._rate(name), []).append((name, parameter))
        groups = [
            {"params": some, "weight_decay": decay, "lr": rate}
            for rate, parameters in by_rate.items()
            for some, decay in zip(_decaying(parameters), (self.weight_decay, 0.0), strict=True)
            if some
        ]
        return EagerAdamW(groups, lr=self.learning_rate, betas=(self.beta1, self.beta2), fused=True)

    def remembers(self, shape: Sequence[int]) -> int:
        """Return two means."""
        return 2 * math.prod(shape)

    def _rate(self, name: str) -> float:
        # The dots keep `backbone.recurrent` from matching `backbone.recurrent2`.
        return next((rate for part, rate in self.rates if f"{name}.".startswith(f"{part}.")), self.learning_rate)


@OPTIMIZERS.register("soap")
@dataclass(frozen=True, kw_only=True)
class Soap:
    """Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al. 2024, arXiv 2409.11321).

    On networks of this size a step costs little more than AdamW's and the error falls several times faster per
    processor second; see docs/journal.

    Attributes:
        learning_rate: base rate.
        weight_decay: lambda, decoupled.
        beta1: decay of the mean of gradients.
        beta2: decay of the second moments.
        refresh: updates between refreshes of the eigenbasis.
    """

    # 6e-3 and 0.95: least validation error of the settings tried (docs/journal, SOAP for 3,000 updates).
    learning_rate: float = 6e-3
    weight_decay: float = 1e-4
    beta1: float = 0.95
    beta2: float = 0.95
    refresh: int = 10

    def __post_init__(self) -> None:
        check_bounds(
            "soap",
            self,
            learning_rate=RATE,
            weight_decay=DECAY,
            beta1=BETA,
            beta2=BETA,
            refresh=integer(1, MAX_UPDATES),
        )

    def build(self, named: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """Create the optimiser of all parameters."""
        from pytorch_optimizer import SOAP  # deferred: only this optimiser needs the library

        return SOAP(
            [parameter for _, parameter in named],
            lr=self.learning_rate,
            betas=(self.beta1, self.beta2),
            weight_decay=self.weight_decay,
            precondition_frequency=self.refresh,
        )

    def remembers(self, shape: Sequence[int]) -> int:
        """Return two means, and two square matrices for each axis of a matrix or kernel."""
        # Vectors are not preconditioned: their matrices would have the square of their length.
        return 2 * math.prod(shape) + (2 * sum(size**2 for size in shape) if len(shape) > 1 else 0)


def _decaying(named: Iterable[tuple[str, nn.Parameter]]) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Return the matrices, on which decay acts, and biases and gains, on which it does not."""
    matrices: list[nn.Parameter] = []
    vectors: list[nn.Parameter] = []
    for name, parameter in named:
        # Decay of gains and biases would pull scales to zero without making the map simpler.
        (matrices if parameter.ndim > 1 and "bias" not in name else vectors).append(parameter)
    return matrices, vectors
