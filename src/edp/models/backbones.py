"""Backbones: LSTM with attention pooling, TCN, and the hybrid TCN-LSTM (thesis 3.2.3), on the streaming contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from edp.blocks.base import BranchMaker, Slot
from edp.errors import ConfigError
from edp.models.convolution import ConvolutionStack, receptive_field
from edp.models.recurrent import AttentionPooling, Lstm
from edp.registry import Registry
from edp.streaming import Chain, Cost, State, Streaming

Blocks = Sequence[object]


class BackboneSpec(Protocol):
    """Options of a backbone."""

    def build(self, features: int, window: int, blocks: Blocks) -> tuple[Streaming, int]:
        """The backbone and the width of its representation; `blocks` are the specs for its slots."""
        ...

    def slots(self) -> tuple[Slot, ...]:
        """The slots that it offers."""
        ...


BACKBONES: Registry[type] = Registry("backbone")


@BACKBONES.register("lstm")
@dataclass(frozen=True, kw_only=True)
class LstmSpec:
    """LSTM with attention pooling over the trailing window (eq. 3.32 to 3.35).

    Attributes:
        units: hidden units D.
        layers: stacked LSTM layers.
        dropout: rate on the hidden states, in training.
    """

    units: int = 64
    layers: int = 1
    dropout: float = 0.0

    def __post_init__(self) -> None:
        _check(self.dropout, units=self.units, layers=self.layers)

    def slots(self) -> tuple[Slot, ...]:
        """Features derived from the recurrent states."""
        return (Slot.FEATURES,)

    def build(self, features: int, window: int, blocks: Blocks) -> tuple[Streaming, int]:
        """The recurrent backbone on the scaled features."""
        net = RecurrentBackbone(None, features, self.units, self.layers, self.dropout, window, blocks)
        return net, net.width


@BACKBONES.register("tcn")
@dataclass(frozen=True, kw_only=True)
class TcnSpec:
    """Temporal convolutional network whose last column is the representation (eq. 3.36 to 3.38).

    Attributes:
        channels: width of each level; the dilation doubles from level to level.
        kernel: kernel size; the receptive field must span the window (R >= W).
        dropout: rate after each convolution, in training.
    """

    channels: tuple[int, ...] = (64, 64, 64, 64)
    kernel: int = 3
    dropout: float = 0.0

    def __post_init__(self) -> None:
        _check(self.dropout, kernel=self.kernel, levels=len(self.channels), channels=min(self.channels, default=0))

    def slots(self) -> tuple[Slot, ...]:
        """Parallel stacks, and what works on their channels."""
        return (Slot.BRANCHES, Slot.CHANNELS)

    def build(self, features: int, window: int, blocks: Blocks) -> tuple[Streaming, int]:
        """The convolution stack(s); refused where the receptive field is shorter than the window."""
        reach = receptive_field(len(self.channels), self.kernel)
        if reach < window:
            levels = next((n for n in range(1, 64) if receptive_field(n, self.kernel) >= window), 0)
            change = f"give {levels} channels entries" if levels else "use a kernel of at least 2"
            raise ConfigError(
                f"tcn: {len(self.channels)} level(s) of kernel {self.kernel} see {reach} samples, the window is "
                f"{window}; R >= W must hold (thesis 3.2.3.2): {change}, a larger kernel or a smaller window"
            )
        return _convolutions(features, self.channels, self.kernel, self.dropout, window, blocks)


@BACKBONES.register("hybrid")
@dataclass(frozen=True, kw_only=True)
class HybridSpec:
    """Convolutions, then a single-layer LSTM with attention pooling (eq. 3.39, 3.40).

    Attributes:
        channels: width of each convolution level.
        kernel: kernel size.
        units: hidden units of the LSTM.
        dropout: rate after each convolution and on the hidden states, in training.
    """

    channels: tuple[int, ...] = (64,)
    kernel: int = 5
    units: int = 64
    dropout: float = 0.0

    def __post_init__(self) -> None:
        _check(
            self.dropout,
            kernel=self.kernel,
            units=self.units,
            levels=len(self.channels),
            channels=min(self.channels, default=0),
        )

    def slots(self) -> tuple[Slot, ...]:
        """Parallel stacks, what works on their channels, and features derived from the recurrent states."""
        return (Slot.BRANCHES, Slot.CHANNELS, Slot.FEATURES)

    def build(self, features: int, window: int, blocks: Blocks) -> tuple[Streaming, int]:
        """Convolutions and the recurrent backbone on their channels."""
        encoder, width = _convolutions(features, self.channels, self.kernel, self.dropout, window, blocks)
        net = RecurrentBackbone(encoder, width, self.units, 1, self.dropout, window, blocks)
        return net, net.width


class RecurrentBackbone(Streaming):
    """``[attention pooling ; h_t ; further features]`` of an LSTM on the input or on an encoder's channels."""

    def __init__(
        self,
        encoder: Streaming | None,
        width_in: int,
        units: int,
        layers: int,
        dropout: float,
        window: int,
        blocks: Blocks,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.lstm = Lstm(width_in, units, layers, dropout)
        self.dropout = nn.Dropout(dropout)
        self.pooling = AttentionPooling(units, window)
        extras = in_slot(blocks, Slot.FEATURES)
        self.extras = nn.ModuleList(spec.build(units, window) for spec in extras)  # type: ignore[attr-defined]
        self.width = 2 * units + sum(spec.extra(units) for spec in extras)  # type: ignore[attr-defined]

    def _tail(self) -> list[Streaming]:
        return [self.pooling, *(extra for extra in self.extras if isinstance(extra, Streaming))]

    def initial_state(self, batch: int, like: Tensor) -> State:
        first = () if self.encoder is None else self.encoder.initial_state(batch, like)
        tail = tuple(part.initial_state(batch, like) for part in self._tail())
        return first, self.lstm.initial_state(batch, like), tail

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        first, recurrent, tail = state
        if self.encoder is not None:
            x, first = self.encoder(x, first)
        h, recurrent = self.lstm(x, recurrent)
        h = self.dropout(h)
        results = [part(h, old) for part, old in zip(self._tail(), tail, strict=True)]
        return torch.cat([y for y, _ in results], dim=-1), (first, recurrent, tuple(new for _, new in results))

    def costs(self) -> list[Cost]:
        encoder = [] if self.encoder is None else self.encoder.costs()
        return encoder + self.lstm.costs() + [cost for part in self._tail() for cost in part.costs()]


def in_slot(blocks: Blocks, slot: Slot) -> list[object]:
    """The block specs that sit in `slot`, in order."""
    return [block for block in blocks if getattr(block, "slot", None) is slot]


def _convolutions(
    features: int, channels: tuple[int, ...], kernel: int, dropout: float, window: int, blocks: Blocks
) -> tuple[Streaming, int]:
    def make_branch(first_dilation: int) -> Streaming:
        return ConvolutionStack(features, channels, kernel, first_dilation, dropout)

    net, width = make_branch(1), channels[-1]
    branches = in_slot(blocks, Slot.BRANCHES)
    if branches:
        build: BranchMaker = make_branch
        net = branches[0].build(build)  # type: ignore[attr-defined]
        width *= len(net.branches)
    behind = [spec.build(width, window) for spec in in_slot(blocks, Slot.CHANNELS)]  # type: ignore[attr-defined]
    return (Chain([net, *behind]) if behind else net), width


def _check(dropout: float, **at_least_one: int) -> None:
    for name, value in at_least_one.items():
        if value < 1:
            raise ConfigError(f"backbone: {name} = {value}; at least 1 must hold")
    if not 0 <= dropout < 1:
        raise ConfigError(f"backbone: dropout = {dropout}; 0 <= dropout < 1 must hold")
