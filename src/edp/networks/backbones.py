"""Backbones on the streaming contract: recurrent, convolutional, and the hybrid of both (thesis 3.2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor, nn

from edp.data.task import Task
from edp.errors import ConfigError, closest
from edp.ir import Builder
from edp.ir.builder import MAX_INDEX
from edp.networks.blocks.base import BlockSlot, BranchMaker
from edp.networks.cells import CellSpec, GruCell, LstmCell, Stack
from edp.networks.cells.base import check_cell
from edp.networks.committee import NON_LINEAR, Committee, Members
from edp.networks.convolution import ConvolutionStack, receptive_field
from edp.networks.initial import InitialSpec, ZeroState
from edp.networks.lag_bank import LagBank, check_lags, check_smoothed
from edp.networks.pooling import AttentionPooling
from edp.networks.radial import MAX_CENTRES, RadialFeatures, check_near
from edp.networks.streaming import Chain, Cost, State, Streaming
from edp.networks.trees import MAX_DEPTH, MAX_TREES, Trees
from edp.registry import Registry
from edp.settings.bounds import (
    MAX_KERNEL,
    MAX_LAYERS,
    MAX_LEVELS,
    MAX_NAMES,
    MAX_UNITS,
    MOST_CHANNELS,
    below,
    check_bounds,
    check_count,
    integer,
)

Blocks = Sequence[object]


class BackboneSpec(Protocol):
    """Options of a backbone."""

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Build the backbone and return it with the width of its representation.

        Args:
            features: numbers that it reads.
            window: samples of its pooling.
            blocks: specs for its slots.
            outputs: numbers that the network predicts, horizons times targets: for parts that answer for each of them.
        """
        ...

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return the block slots of the backbone."""
        ...

    def parts(self) -> tuple[str, ...]:
        """Return the names of its sub-modules, from the input on, for separate learning rates.

        Empty for a single module.
        """
        ...


BACKBONES: Registry[type] = Registry("backbone")
UNITS, LAYERS = integer(1, MAX_UNITS), integer(1, MAX_LAYERS)
CHANNELS, KERNEL = integer(1, MOST_CHANNELS), integer(1, MAX_KERNEL)
DROPOUT = below(0.0, 1.0)


@BACKBONES.register("lstm")
@dataclass(frozen=True, kw_only=True)
class LstmSpec:
    """LSTM with attention pooling over the trailing window (eq. 3.32 to 3.35).

    Attributes:
        units: hidden units D.
        layers: stacked recurrent layers.
        dropout: rate on the hidden states, in training.
        zoneout: probability that a unit keeps its state over a tick, in training; in evaluation states are blended.
        cell: options of a registered recurrent layer, of the family of the LSTM.
        initial: options of a registered initial state: what the state is after a reset.
    """

    units: int = 64
    layers: int = 1
    dropout: float = 0.0
    zoneout: float = 0.0
    cell: CellSpec = field(default_factory=LstmCell)
    initial: InitialSpec = field(default_factory=ZeroState)

    def __post_init__(self) -> None:
        check_bounds("backbone", self, units=UNITS, layers=LAYERS, dropout=DROPOUT, zoneout=DROPOUT)
        check_cell("lstm", self.cell, self.zoneout, families=("lstm",))

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return the features derived from the recurrent states."""
        return (BlockSlot.FEATURES,)

    def parts(self) -> tuple[str, ...]:
        """Return the recurrent layers, then the modules that read their states."""
        return ("recurrent", "pooling", "extras")

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Build the recurrent backbone on the scaled features."""
        stack = Stack(self.cell, features, self.units, self.layers, self.dropout, self.zoneout)
        net = RecurrentBackbone(None, self.initial.build(stack, features), self.units, self.dropout, window, blocks)
        return net, net.width


@BACKBONES.register("gru")
@dataclass(frozen=True, kw_only=True)
class GruSpec:
    """GRU with attention pooling over the trailing window (eq. 3.12 to 3.15, 3.33 to 3.35).

    Attributes:
        units: hidden units D.
        layers: stacked recurrent layers.
        dropout: rate on the hidden states, in training.
        cell: options of a registered recurrent layer, of the family of the GRU.
        initial: options of a registered initial state: what the state is after a reset.
    """

    units: int = 64
    layers: int = 1
    dropout: float = 0.0
    cell: CellSpec = field(default_factory=GruCell)
    initial: InitialSpec = field(default_factory=ZeroState)

    def __post_init__(self) -> None:
        check_bounds("backbone", self, units=UNITS, layers=LAYERS, dropout=DROPOUT)
        check_cell("gru", self.cell, 0.0, families=("gru",))

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return the features derived from the recurrent states."""
        return (BlockSlot.FEATURES,)

    def parts(self) -> tuple[str, ...]:
        """Return the recurrent layers, then the modules that read their states."""
        return ("recurrent", "pooling", "extras")

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Build the recurrent backbone on the scaled features."""
        stack = Stack(self.cell, features, self.units, self.layers, self.dropout)
        net = RecurrentBackbone(None, self.initial.build(stack, features), self.units, self.dropout, window, blocks)
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
        check_count("backbone", "channels", self.channels, MAX_LEVELS, least=1)
        check_bounds("backbone", self, channels=CHANNELS, kernel=KERNEL, dropout=DROPOUT)

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return the parallel stacks, and what works on their channels."""
        return (BlockSlot.BRANCHES, BlockSlot.CHANNELS)

    def parts(self) -> tuple[str, ...]:
        """Return an empty tuple, since the backbone is a single module."""
        return ()

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Build the convolution stacks; raises ConfigError if the receptive field is shorter than the window."""
        reach = receptive_field(len(self.channels), self.kernel)
        if reach < window:
            # 64 levels exceed any window that fits in memory; with kernel 1 the field stays one sample at every depth.
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
    """Convolutions, then a recurrent layer, the LSTM of the thesis or another, with attention pooling (eq. 3.39, 3.40).

    Attributes:
        channels: width of each convolution level.
        kernel: kernel size.
        units: hidden units of the recurrent layer.
        layers: stacked recurrent layers; the thesis has one.
        dropout: rate after each convolution and on the hidden states, in training.
        zoneout: probability that a unit keeps its state over a tick, in training; in evaluation states are blended.
        cell: options of a registered recurrent layer.
        initial: options of a registered initial state: what the state is after a reset.
    """

    channels: tuple[int, ...] = (64,)
    kernel: int = 5
    units: int = 64
    layers: int = 1
    dropout: float = 0.0
    zoneout: float = 0.0
    cell: CellSpec = field(default_factory=LstmCell)
    initial: InitialSpec = field(default_factory=ZeroState)

    def __post_init__(self) -> None:
        check_count("backbone", "channels", self.channels, MAX_LEVELS, least=1)
        check_bounds("backbone", self, channels=CHANNELS, kernel=KERNEL, units=UNITS, layers=LAYERS)
        check_bounds("backbone", self, dropout=DROPOUT, zoneout=DROPOUT)
        check_cell("hybrid", self.cell, self.zoneout)

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return the parallel stacks, what works on their channels, and features derived from the recurrent states."""
        return (BlockSlot.BRANCHES, BlockSlot.CHANNELS, BlockSlot.FEATURES)

    def parts(self) -> tuple[str, ...]:
        """Return the convolutions, the recurrent layers, then the modules that read their states."""
        return ("encoder", "recurrent", "pooling", "extras")

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Return the convolutions and the recurrent backbone on their channels."""
        encoder, width = _convolutions(features, self.channels, self.kernel, self.dropout, window, blocks)
        stack = Stack(self.cell, width, self.units, self.layers, self.dropout, self.zoneout)
        net = RecurrentBackbone(encoder, self.initial.build(stack, width), self.units, self.dropout, window, blocks)
        return net, net.width


@BACKBONES.register("committee")
@dataclass(frozen=True, kw_only=True)
class CommitteeSpec:
    """Ensemble of perceptrons on present values and their changes over several spans, for a linear head.

    The backbone has no recurrence: a member reads only changes over `lags` samples. With the head ``linear`` the
    prediction is a linear map of the changes plus a weighted mean of the members.

    Attributes:
        lags: spans in ticks, rising.
        smoothed: spans among `lags` over which the mean of as many ticks also gives its change.
        members: perceptrons for each activation.
        units: hidden units of each layer of a member.
        layers: hidden layers of a member.
        activations: ``tanh``, ``relu`` or both; each has its own group of members. None leaves the linear model.
        dropout: rate after each hidden layer, in training.
        centres: radial basis functions on all columns; a training on folds places them.
        local_lags: additional perceptrons that read the present values and the changes over one span only. Each entry
            selects
            the span among `lags`; 0 selects present values alone. With few rows, perceptrons of few inputs generalise
            better.
        trees: regression trees for each predicted number; their sums join the representation. A training on folds
            fits them.
        tree_depth: comparisons from the root of a tree to a
            leaf.
        clip_inputs: whether present values and changes far outside what a training on folds saw are held at limits
            around
            it. An axis that first moves on the machine, or a sensor that jumps, is then no multiple of what trained.
    """

    # Spans in powers of two cover 0.01 to 0.32 s at 100 Hz with few columns.
    lags: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    smoothed: tuple[int, ...] = ()
    members: int = 10
    units: int = 64
    layers: int = 2
    activations: tuple[str, ...] = ("tanh", "relu")
    dropout: float = 0.0
    centres: int = 0
    local_lags: tuple[int, ...] = ()
    trees: int = 0
    tree_depth: int = 4
    clip_inputs: bool = False

    def __post_init__(self) -> None:
        check_count("backbone", "lags", self.lags, MAX_LEVELS, least=1)
        check_lags(self.lags)
        check_smoothed(self.lags, self.smoothed)
        check_count("backbone", "activations", self.activations, len(NON_LINEAR))
        check_bounds("backbone", self, members=integer(1, MAX_NAMES), units=UNITS, layers=LAYERS, dropout=DROPOUT)
        check_bounds("backbone", self, trees=integer(0, MAX_TREES), tree_depth=integer(1, MAX_DEPTH))
        check_bounds("backbone", self, centres=integer(0, MAX_CENTRES))
        check_near(self.local_lags, self.lags, self.centres)
        for name in self.activations:
            if name not in NON_LINEAR or self.activations.count(name) > 1:
                raise ConfigError(
                    f"committee: activations = {list(self.activations)}; each of {', '.join(NON_LINEAR)} at most once "
                    f"must hold{closest(name, [*NON_LINEAR])}"
                )

    def conflicts(self, model: object, task: Task) -> str | None:
        """Return the trees that read more columns than their tables can name."""
        columns = len(task.features.features) * (1 + len(self.lags) + len(self.smoothed))
        if self.trees and columns > MAX_INDEX + 1:
            return (
                f"committee: trees would read {columns:,} columns (features times 1 + lags + smoothed); at most "
                f"{MAX_INDEX + 1:,} must hold: give fewer channels or lags, or trees = 0"
            )
        return None

    def slots(self) -> tuple[BlockSlot, ...]:
        """Return None, since the members are the complete network."""
        return ()

    def parts(self) -> tuple[str, ...]:
        """Return the members and the radial basis functions; differences and trees are not trained by gradients."""
        return ("groups", *(["radial"] if self.centres else []), *(["near"] if self.local_lags else []))

    def build(self, features: int, window: int, blocks: Blocks, outputs: int = 1) -> tuple[Streaming, int]:
        """Build the bank of differences, and the members and trees on it."""
        bank = LagBank(features, self.lags, self.smoothed, self.clip_inputs)
        groups = [
            Members(bank.columns, self.members, self.units, self.layers, name, self.dropout)
            for name in self.activations
        ]
        trees = Trees(bank.columns, outputs, self.trees, self.tree_depth) if self.trees else None
        radial = RadialFeatures(bank.columns, self.centres) if self.centres else None
        near = [RadialFeatures(bank.columns, self.centres, bank.columns_over(span)) for span in self.local_lags]
        net = Committee(bank, groups, radial, near, trees)
        return net, net.width


class RecurrentBackbone(Streaming):
    """``[attention pooling ; h_t .

    Extra features]`` of recurrent layers on the input or on the channels of an encoder.
    """

    def __init__(
        self, encoder: Streaming | None, recurrent: Streaming, units: int, dropout: float, window: int, blocks: Blocks
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.recurrent = recurrent
        # Dropout acts behind the recurrence, not inside it: masks within the loop would erase what the state carries.
        self.dropout = nn.Dropout(dropout)
        self.pooling = AttentionPooling(units, window)
        extras = select_slot(blocks, BlockSlot.FEATURES)
        self.extras = nn.ModuleList(spec.build(units, window) for spec in extras)  # type: ignore[attr-defined]
        self.width = 2 * units + sum(spec.extra(units) for spec in extras)  # type: ignore[attr-defined]

    def _tail(self) -> list[Streaming]:
        return [self.pooling, *(extra for extra in self.extras if isinstance(extra, Streaming))]

    def initial_state(self, batch: int, like: Tensor) -> State:
        first = () if self.encoder is None else self.encoder.initial_state(batch, like)
        tail = tuple(part.initial_state(batch, like) for part in self._tail())
        return first, self.recurrent.initial_state(batch, like), tail

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        first, recurrent, tail = state
        if self.encoder is not None:
            x, first = self.encoder(x, first)
        h, recurrent = self.recurrent(x, recurrent)
        h = self.dropout(h)
        results = [part(h, old) for part, old in zip(self._tail(), tail, strict=True)]
        return torch.cat([y for y, _ in results], dim=-1), (first, recurrent, tuple(new for _, new in results))

    def lower(self, build: Builder, x: str) -> str:
        if self.encoder is not None:
            with build.inside("encoder"):
                x = self.encoder.lower(build, x)
        h = self.recurrent.lower(build, x)
        parts = [part.lower(build, h) for part in self._tail()]
        return build.join("representation", *parts)

    def costs(self) -> list[Cost]:
        encoder = [] if self.encoder is None else self.encoder.costs()
        return encoder + self.recurrent.costs() + [cost for part in self._tail() for cost in part.costs()]


def select_slot(blocks: Blocks, slot: BlockSlot) -> list[object]:
    """Return the block specs of `slot`, in order."""
    return [block for block in blocks if getattr(block, "slot", None) is slot]


def _convolutions(
    features: int, channels: tuple[int, ...], kernel: int, dropout: float, window: int, blocks: Blocks
) -> tuple[Streaming, int]:
    def make_branch(first_dilation: int) -> Streaming:
        return ConvolutionStack(features, channels, kernel, first_dilation, dropout)

    net, width = make_branch(1), channels[-1]
    branches = select_slot(blocks, BlockSlot.BRANCHES)
    if branches:
        build: BranchMaker = make_branch
        net = branches[0].build(build)  # type: ignore[attr-defined]
        width *= len(net.branches)
    # Blocks of the channels come behind the joined branches, so that they see the channels of all scales.
    behind = [spec.build(width, window) for spec in select_slot(blocks, BlockSlot.CHANNELS)]  # type: ignore[attr-defined]
    return (Chain([net, *behind]) if behind else net), width
