"""Squeeze-and-excitation: weigh the channels of the convolutions by their mean (eq. 3.17, 3.18)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Dense, Function
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of
from edp.networks.trailing import StreamingTrailingMean
from edp.settings.bounds import MOST_CHANNELS, check_bounds, integer


@BLOCKS.register("squeeze_excitation")
@dataclass(frozen=True, kw_only=True)
class SqueezeExcitation:
    """Multiply channel u by ``s = sigmoid(W_2 relu(W_1 z))``, z its mean over the trailing window; no biases.

    Every tick has its own mean over the last `window` ticks. The thesis computes one s from the whole window and scales
    all its ticks by it: the last tick is the same number, the earlier ones, which the LSTM has read by then, are not.

    Attributes:
        reduction: channels divided by this are the bottleneck between W_1 and W_2, at least one.

    Raises:
        ConfigError: reduction below 1.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
    space: ClassVar[dict[str, object]] = {"reduction": (2, 4, 8)}
    reduction: int = 4

    def __post_init__(self) -> None:
        check_bounds("squeeze_excitation", self, reduction=integer(1, MOST_CHANNELS))

    def build(self, width: int, window: int) -> Streaming:
        """Build the block on `width` channels."""
        # A bottleneck of at least one unit, for networks narrower than the reduction.
        return _SqueezeExcitation(width, window, max(1, width // self.reduction))


class _SqueezeExcitation(Streaming):
    operations = frozenset({Operation.LINEAR, Operation.RELU, Operation.SIGMOID})

    def __init__(self, width: int, window: int, bottleneck: int) -> None:
        super().__init__()
        self.width = width
        self.mean = StreamingTrailingMean(width, window)
        self.squeeze = nn.Linear(width, bottleneck, bias=False)
        self.excite = nn.Linear(bottleneck, width, bias=False)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return self.mean.initial_state(batch, like)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        mean, state = self.mean(x, state)
        return torch.sigmoid(self.excite(torch.relu(self.squeeze(mean)))) * x, state

    def lower(self, build: Builder, x: str) -> str:
        down, up = self.squeeze.weight, self.excite.weight
        with build.inside("squeeze_excitation"):
            # The exported dense layer always has a bias; zeros give the same numbers.
            s = build.add(Dense, "squeeze", self.mean.lower(build, x), weight=down, bias=down.new_zeros(len(down)))
            s = build.add(Activate, "relu", s, function=Function.RELU, size=len(down))
            s = build.add(Dense, "excite", s, weight=up, bias=up.new_zeros(len(up)))
            s = build.add(Activate, "sigmoid", s, function=Function.SIGMOID, size=self.width)
            return build.combine("weighted", BinaryOperation.MULTIPLY, s, x)

    def costs(self) -> list[Cost]:
        """Return the costs per column, since every sample has its own weights."""
        weights = parameters_of(self)
        own = Cost("squeeze-excitation", weights, per_column=weights, width_in=self.width, width_out=self.width)
        return [*self.mean.costs(), own]
