"""Machine code: a few parameters per machine scale and shift the convolution channels (FiLM, arXiv 1709.07871)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import ScaleShift
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, State, Streaming, parameters_of
from edp.settings.bounds import MAX_UNITS, check_bounds, integer

CODE = "machine_code"
"""Last part of the name of the parameter that is the code."""
_SPREAD = 0.02
"""Deviation of the maps' first weights: nearly the network without the block, and no code is without effect."""


@BLOCKS.register("machine_code")
@dataclass(frozen=True, kw_only=True)
class MachineCode:
    """Channel u becomes ``u (1 + G z) + S z``; z is the machine's code, a constant of the network.

    An unknown machine has the code zero. `edp train pretrain --method codes` trains G, S and one code per machine;
    `edp train finetune --method code` fits only z. Exports contain the resulting gains and shifts instead of the code.

    Attributes:
        size: numbers of a code.

    Raises:
        ConfigError: size out of range.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
    space: ClassVar[dict[str, object]] = {}
    size: int = 16

    def __post_init__(self) -> None:
        check_bounds("machine_code", self, size=integer(1, MAX_UNITS))

    def build(self, width: int, window: int) -> Streaming:
        """Build the block on `width` channels."""
        return CodedChannels(width, self.size)


class CodedChannels(Streaming):
    """The block.

    Attributes:
        lanes: codes ``(batch, size)`` of the streams of a batch, in a training over machines; None for the network's
            own.
        table: codes of all machines in a row; there while a training over machines lasts.
    """

    table: Tensor
    lanes: Tensor | None = None

    def __init__(self, width: int, size: int) -> None:
        super().__init__()
        self.width = width
        self.machine_code = nn.Parameter(torch.zeros(size))
        self.scale_map = nn.Parameter(torch.empty(width, size).normal_(std=_SPREAD))
        self.shift_map = nn.Parameter(torch.empty(width, size).normal_(std=_SPREAD))

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        gain, shift = self._compute_gains(self.machine_code if self.lanes is None else self.lanes.unsqueeze(1))
        return x * gain + shift, state

    def _compute_gains(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gain and shift of each channel ``(..., width)`` from codes ``(..., size)``."""
        each = code.unsqueeze(-2)
        return 1.0 + (self.scale_map * each).sum(dim=-1), (self.shift_map * each).sum(dim=-1)

    def lower(self, build: Builder, x: str) -> str:
        gain, shift = self._compute_gains(self.machine_code)
        return build.add(ScaleShift, "machine_code", x, gain=gain, shift=shift)

    def costs(self) -> list[Cost]:
        """Return the costs: one product per channel. Gains and shifts are constants of the machine."""
        return [
            Cost(
                "machine code",
                parameters_of(self),
                width_in=self.width,
                width_out=self.width,
            )
        ]
