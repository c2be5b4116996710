"""Temporal differencing: the change of the recurrent state over the last sample as additional features (eq. 3.16)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.ir import Builder
from edp.ir.memory import Difference
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, State, Streaming


@BLOCKS.register("temporal_difference")
@dataclass(frozen=True, kw_only=True)
class TemporalDifference:
    """Concatenate ``h_t - h_{t-1}`` to the representation; before the first tick h is zero, as at reset."""

    slot: ClassVar[BlockSlot] = BlockSlot.FEATURES
    space: ClassVar[dict[str, object]] = {}

    def extra(self, width: int) -> int:
        """Return the number of features added for recurrent states of `width`."""
        return width

    def build(self, width: int, window: int) -> Streaming:
        """Build the differencing module."""
        return _Difference(width)


class _Difference(Streaming):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, 1, self.width)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        # The state holds the last tick of the previous chunk, so that a chunk boundary leaves no jump.
        before = torch.cat([state, x[:, :-1]], dim=1)
        return x - before, x[:, -1:]

    def lower(self, build: Builder, x: str) -> str:
        return build.add(Difference, "change", x, factor=torch.ones(self.width), from_zero=True)

    def costs(self) -> list[Cost]:
        return [Cost("temporal difference", 0, width_in=self.width, width_out=self.width, per_time_step=False)]
