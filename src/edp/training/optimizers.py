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
        matrices: list[nn.Parameter] = []
        vectors: list[nn.Parameter] = []
        for name, parameter in named:
            (matrices if parameter.ndim > 1 and "bias" not in name else vectors).append(parameter)
        groups = [{"params": matrices, "weight_decay": self.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        return torch.optim.AdamW(groups, lr=self.learning_rate, betas=(self.beta1, self.beta2), fused=True)
