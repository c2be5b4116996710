"""Ensemble of small networks and regression trees in parallel, on the same changes over several time spans."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Activate, Dense, Function, GroupedDense
from edp.networks.lag_bank import LagBank
from edp.networks.radial import RadialFeatures
from edp.networks.streaming import Cost, Operation, State, Streaming
from edp.networks.trees import Trees

NON_LINEAR: dict[str, tuple[Callable[[Tensor], Tensor], Operation, Function]] = {
    "tanh": (torch.tanh, Operation.TANH, Function.TANH),
    "relu": (torch.relu, Operation.RELU, Function.RELU),
}
"""Element-wise activation functions of the hidden units, by name."""


class Members(Streaming):
    """Perceptrons of equal size without memory, ``(batch, time, width)`` to ``(batch, time, members units)``.

    Attributes:
        weights: weights of each layer, ``(member, in, units)``; `biases` has shape ``(member, units)``.
    """

    matrices = (("weights", (0, 2)),)

    def __init__(self, width: int, members: int, units: int, layers: int, activation: str, dropout: float) -> None:
        super().__init__()
        self.width, self.members, self.units = width, members, units
        self.function, operation, self.layer = NON_LINEAR[activation]
        self.operations = frozenset({Operation.LINEAR, operation})
        self.dropout = nn.Dropout(dropout)
        sizes = [width] + [units] * layers
        self.weights = nn.ParameterList(
            nn.Parameter(torch.randn(members, into, units) / math.sqrt(into)) for into in sizes[:-1]
        )
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(members, units)) for _ in range(layers))

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        first = self.weights[0].transpose(0, 1).flatten(1)
        y = (x @ first).unflatten(-1, (self.members, self.units)) + self.biases[0]
        y = self.dropout(self.function(y))
        for weight, bias in zip(list(self.weights)[1:], list(self.biases)[1:], strict=True):
            y = self.dropout(self.function(torch.einsum("btmi,mio->btmo", y, weight) + bias))
        return y.flatten(-2), state

    def lower(self, build: Builder, x: str) -> str:
        weights = [weight.transpose(1, 2) for weight in self.weights]
        size = self.members * self.units
        for number, (weight, bias) in enumerate(zip(weights, self.biases, strict=True), start=1):
            kind: Any = GroupedDense
            if number == 1:
                kind, weight, bias = Dense, weight.flatten(0, 1), bias.flatten()
            x = build.add(kind, f"layer{number}", x, weight=weight, bias=bias)
            x = build.add(Activate, f"active{number}", x, function=self.layer, size=size)
        return x

    def costs(self) -> list[Cost]:
        macs = sum(weight.numel() for weight in self.weights)
        return [
            Cost(
                f"{self.members} perceptrons {self.width}-" + "-".join([str(self.units)] * len(self.weights)),
                macs + sum(bias.numel() for bias in self.biases),
                per_prediction=macs,
                width_in=self.width,
                width_out=self.members * self.units,
                per_time_step=False,
            )
        ]


class Committee(Streaming):
    """Features of an ensemble: ``[bank ; hidden units ; radial functions ; sparse radial functions ; tree sums]``.

    A linear head on it is a linear model plus a weighted mean of perceptrons, a kernel machine and sums of trees.

    Args:
        bank: lag bank that computes the inputs of all other parts.
        groups: groups of perceptrons.
        radial: radial basis functions on all columns; None without them.
        near: radial basis functions on few columns each.
        trees: number of trees for each prediction (horizon and target); None without trees.
    """

    def __init__(
        self,
        bank: LagBank,
        groups: Sequence[Members],
        radial: RadialFeatures | None = None,
        near: Sequence[RadialFeatures] = (),
        trees: Trees | None = None,
    ) -> None:
        super().__init__()
        self.bank = bank
        self.groups = nn.ModuleList(groups)
        self.radial = radial
        self.near = nn.ModuleList(near)
        self.trees = trees

    @property
    def width(self) -> int:
        """Numbers of the representation."""
        hidden = sum(group.members * group.units for group in self.members)
        radial = sum(functions.count for functions in self.radials)
        return self.bank.columns + hidden + radial + (0 if self.trees is None else self.trees.outputs)

    @property
    def members(self) -> list[Members]:
        """The groups of perceptrons."""
        return [group for group in self.groups if isinstance(group, Members)]

    @property
    def radials(self) -> list[RadialFeatures]:
        """Radial basis functions on all columns, followed by radial basis functions on few columns."""
        parts = (self.radial, *self.near)
        return [functions for functions in parts if isinstance(functions, RadialFeatures)]

    def readers(self) -> dict[str, Streaming]:
        """Return the readers of the bank by name, in the order of the representation."""
        readers: dict[str, Streaming] = {f"group{at}": group for at, group in enumerate(self.members)}
        near = {f"near{at}": part for at, part in enumerate(self.near) if isinstance(part, RadialFeatures)}
        further = {"radial": self.radial, **near, "trees": self.trees}
        return readers | {name: part for name, part in further.items() if part is not None}

    def initial_state(self, batch: int, like: Tensor) -> State:
        return self.bank.initial_state(batch, like)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        bank, state = self.bank(x, state)
        return torch.cat([bank, *(part(bank, ())[0] for part in self.readers().values())], dim=-1), state

    def lower(self, build: Builder, x: str) -> str:
        with build.inside("bank"):
            bank = self.bank.lower(build, x)
        parts = []
        for name, part in self.readers().items():
            with build.inside(name):
                parts.append(part.lower(build, bank))
        return build.join("representation", bank, *parts)

    def costs(self) -> list[Cost]:
        return self.bank.costs() + [cost for part in self.readers().values() for cost in part.costs()]
