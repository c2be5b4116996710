"""Causal dilated convolutions with ring-buffer state, and the stacks built from them."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Dense, Function
from edp.ir.memory import Convolution
from edp.networks.streaming import Cost, Operation, State, Streaming


class CausalConv(Streaming):
    """Weight-normed causal dilated convolution (eq. 2.8), ``w = gain * v / ||v||`` per output channel.

    Maps ``(batch, time, channels_in)`` to ``(batch, time, channels_out)``; the state is the last
    ``(kernel - 1) * dilation`` inputs, zero at reset, which equals zero padding on the left.
    """

    operations = frozenset({Operation.CONV1D})
    matrices = (("direction", (0,)),)

    def __init__(self, channels_in: int, channels_out: int, kernel: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        # Samples that the kernel reaches back; the state holds exactly these.
        self.memory = (kernel - 1) * dilation
        self.direction = nn.Parameter(torch.empty(channels_out, channels_in, kernel))
        self.gain = nn.Parameter(torch.empty(channels_out))
        self.bias = nn.Parameter(torch.empty(channels_out))
        # He initialisation for the ReLU that follows; the gain starts at the norm, so w starts at v.
        nn.init.kaiming_normal_(self.direction, nonlinearity="relu")
        bound = 1.0 / math.sqrt(channels_in * kernel)
        with torch.no_grad():
            self.gain.copy_(self.direction.flatten(1).norm(dim=1))
            self.bias.uniform_(-bound, bound)

    def weight(self) -> Tensor:
        """Return the kernel with its weight norm, ``(channels_out, channels_in, kernel)``."""
        norm = self.direction.flatten(1).norm(dim=1)
        result: Tensor = self.direction * (self.gain / norm)[:, None, None]
        return result

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.memory, self.direction.shape[1])

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        history = torch.cat([state, x], dim=1)
        y = functional.conv1d(history.transpose(1, 2), self.weight(), self.bias, dilation=self.dilation)
        return y.transpose(1, 2), history[:, x.shape[1] :]

    def lower(self, build: Builder, x: str) -> str:
        weight = self.weight().transpose(1, 2)
        return build.add(Convolution, "convolution", x, weight=weight, bias=self.bias, dilation=self.dilation)

    def costs(self) -> list[Cost]:
        out, into, kernel = self.direction.shape
        return [
            Cost(
                f"convolution {into}->{out}, kernel {kernel}, dilation {self.dilation}",
                self.direction.numel() + 2 * out,
                foldable=out,
                per_column=self.direction.numel(),
                width_in=into,
                width_out=out,
            )
        ]


class TemporalBlock(Streaming):
    """Two convolutions with ReLU and dropout, plus a residual path (eq. 2.10, 3.36); 1x1 where the width changes."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.first = CausalConv(channels_in, channels_out, kernel, dilation)
        self.second = CausalConv(channels_out, channels_out, kernel, dilation)
        self.dropout = nn.Dropout(dropout)
        self.shortcut = nn.Linear(channels_in, channels_out) if channels_in != channels_out else None
        self.operations = frozenset({Operation.RELU, *([Operation.LINEAR] if self.shortcut else [])})

    def initial_state(self, batch: int, like: Tensor) -> State:
        return self.first.initial_state(batch, like), self.second.initial_state(batch, like)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        y, first = self.first(x, state[0])
        y, second = self.second(self.dropout(torch.relu(y)), state[1])
        y = self.dropout(torch.relu(y))
        return y + (x if self.shortcut is None else self.shortcut(x)), (first, second)

    def lower(self, build: Builder, x: str) -> str:
        y, size = x, self.second.direction.shape[0]
        for name, part in (("first", self.first), ("second", self.second)):
            with build.inside(name):
                y = build.add(Activate, "relu", part.lower(build, y), function=Function.RELU, size=size)
        if self.shortcut is not None:
            x = build.add(Dense, "shortcut", x, weight=self.shortcut.weight, bias=self.shortcut.bias)
        return build.combine("sum", BinaryOperation.ADD, y, x)

    def costs(self) -> list[Cost]:
        rows = self.first.costs() + self.second.costs()
        if self.shortcut is not None:
            into, out = self.shortcut.in_features, self.shortcut.out_features
            rows.append(
                Cost(f"residual {into}->{out}", into * out + out, per_column=into * out, width_in=into, width_out=out)
            )
        return rows


class ConvolutionStack(Streaming):
    """Temporal blocks with dilations ``first, 2 first, 4 first, ...``, one per entry of `channels`."""

    def __init__(
        self, width_in: int, channels: tuple[int, ...], kernel: int, first_dilation: int, dropout: float
    ) -> None:
        super().__init__()
        widths = (width_in, *channels)
        # Dilations double from level to level, so that the receptive field grows exponentially with depth (eq. 3.37).
        self.levels = nn.ModuleList(
            TemporalBlock(widths[i], widths[i + 1], kernel, first_dilation * 2**i, dropout)
            for i in range(len(channels))
        )

    def _blocks(self) -> list[TemporalBlock]:
        return [level for level in self.levels if isinstance(level, TemporalBlock)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        return tuple(block.initial_state(batch, like) for block in self._blocks())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        new = []
        for block, old in zip(self._blocks(), state, strict=True):
            x, block_state = block(x, old)
            new.append(block_state)
        return x, tuple(new)

    def lower(self, build: Builder, x: str) -> str:
        for number, block in enumerate(self._blocks(), start=1):
            with build.inside(f"level{number}"):
                x = block.lower(build, x)
        return x

    def costs(self) -> list[Cost]:
        return [cost for block in self._blocks() for cost in block.costs()]


def receptive_field(levels: int, kernel: int) -> int:
    """Return the receptive field of a stack with dilations 1, 2, 4, ... in samples (eq. 3.37)."""
    # Two convolutions a level give the factor 2 (eq. 3.37).
    return int(1 + 2 * (kernel - 1) * (2**levels - 1))
