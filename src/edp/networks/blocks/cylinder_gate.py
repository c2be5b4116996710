"""Cylinder feature gate: a sigmoid gate on the shared representation for each output (eq. 3.20 to 3.22)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.errors import ConfigError, closest
from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Dense, Function, ScaleShift
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of

OPEN_BIAS = 4.0  # sigmoid(4) = 0.98: transparent at the start of training (thesis 3.2.2.2)


@BLOCKS.register("cylinder_gate")
@dataclass(frozen=True, kw_only=True)
class CylinderGate:
    """Gate the representation h separately for each cylinder before its head.

    Attributes:
        form: ``diagonal`` (eq. 3.22, scale and bias per feature) or ``linear`` (eq. 3.21, a full matrix).

    Raises:
        ConfigError: unknown form.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.GATE
    space: ClassVar[dict[str, object]] = {"form": ("diagonal", "linear")}
    form: str = "diagonal"

    def __post_init__(self) -> None:
        if self.form not in ("diagonal", "linear"):
            raise ConfigError(f"cylinder_gate: unknown form '{self.form}'{closest(self.form, ('diagonal', 'linear'))}")

    def build(self, width: int, outputs: int) -> Streaming:
        """Return the gate from ``(batch, time, width)`` to ``(batch, time, outputs, width)``."""
        return _DiagonalGate(width, outputs) if self.form == "diagonal" else _LinearGate(width, outputs)


class _DiagonalGate(Streaming):
    operations = frozenset({Operation.SIGMOID})

    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(outputs, width))
        self.bias = nn.Parameter(torch.full((outputs, width), OPEN_BIAS))
        # Small random slopes break the symmetry between outputs and leave the gate nearly transparent.
        nn.init.normal_(self.scale, std=0.01)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h = x.unsqueeze(-2)
        return torch.sigmoid(self.scale * h + self.bias) * h, state

    def lower(self, build: Builder, x: str) -> str:
        outputs, width = self.scale.shape
        wide = outputs * width
        with build.inside("gate"):
            # A copy for each output: layers of a graph have no broadcasting.
            every = build.pick("repeated", x, list(range(width)) * outputs)
            gate = build.add(ScaleShift, "scaled", every, gain=self.scale.flatten(), shift=self.bias.flatten())
            gate = build.add(Activate, "sigmoid", gate, function=Function.SIGMOID, size=wide)
            return build.combine("gated", BinaryOperation.MULTIPLY, gate, every)

    def costs(self) -> list[Cost]:
        outputs, width = self.scale.shape
        wide = outputs * width
        return [Cost("cylinder gate", 2 * wide, width_in=width, width_out=wide, per_time_step=False)]


class _LinearGate(Streaming):
    operations = frozenset({Operation.LINEAR, Operation.SIGMOID})

    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.width, self.outputs = width, outputs
        self.gate = nn.Linear(width, outputs * width)
        nn.init.constant_(self.gate.bias, OPEN_BIAS)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        gate = torch.sigmoid(self.gate(x)).unflatten(-1, (self.outputs, self.width))
        return gate * x.unsqueeze(-2), state

    def lower(self, build: Builder, x: str) -> str:
        wide = self.outputs * self.width
        with build.inside("gate"):
            gate = build.add(Dense, "linear", x, weight=self.gate.weight, bias=self.gate.bias)
            gate = build.add(Activate, "sigmoid", gate, function=Function.SIGMOID, size=wide)
            every = build.pick("repeated", x, list(range(self.width)) * self.outputs)
            return build.combine("gated", BinaryOperation.MULTIPLY, gate, every)

    def costs(self) -> list[Cost]:
        wide = self.outputs * self.width
        return [
            Cost(
                "cylinder gate",
                parameters_of(self),
                per_prediction=wide * self.width,
                width_in=self.width,
                width_out=wide,
                per_time_step=False,
            )
        ]
