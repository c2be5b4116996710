"""Cross-cylinder attention: the heads of the cylinders see one another before their last layer (eq. 3.23)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import BinaryOperation, Dense, LayerNorm, RowAttention
from edp.networks.blocks.base import BLOCKS, BlockSlot, ModelView, TaskView
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of


@BLOCKS.register("cross_cylinder_attention")
@dataclass(frozen=True, kw_only=True)
class CrossCylinderAttention:
    """``C' = LayerNorm(C + MHA(C, C, C))`` over the outputs, with one attention head, at each tick on its own.

    C stacks the hidden features of the heads, one row for each output.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.MIX
    space: ClassVar[dict[str, object]] = {}

    def conflicts(self, model: ModelView, task: TaskView) -> str | None:
        """Return the reason why the block is invalid for a single output: attention needs at least two outputs."""
        if len(task.targets) > 1:
            return None
        return (
            f"cross_cylinder_attention lets the outputs see one another, and the task has one, {task.targets[0]}; "
            "remove the block or predict two targets or more"
        )

    def build(self, hidden: int, outputs: int) -> Streaming:
        """Build the layer on `outputs` rows of `hidden` features."""
        return _Across(hidden, outputs)


class _Across(Streaming):
    operations = frozenset({Operation.LAYER_NORM, Operation.LINEAR, Operation.MATMUL, Operation.SOFTMAX})

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.hidden, self.outputs = hidden, outputs
        self.project, self.gather = nn.Linear(hidden, 3 * hidden), nn.Linear(hidden, hidden)
        self.norm = nn.LayerNorm(hidden)
        nn.init.xavier_uniform_(self.project.weight)
        for bias in (self.project.bias, self.gather.bias):
            nn.init.zeros_(bias)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        query, key, value = self.project(x).chunk(3, dim=-1)
        weights = (query @ key.transpose(-2, -1) / math.sqrt(self.hidden)).softmax(dim=-1)
        # The norm stands behind the sum (post-norm), as in eq. 3.23.
        return self.norm(x + self.gather(weights @ value)), state

    def lower(self, build: Builder, x: str) -> str:
        rows, wide = self.outputs, self.hidden
        with build.inside("across"):
            qkv = [
                build.add(Dense, name, x, weight=weight, bias=bias, rows=rows)
                for name, weight, bias in zip(
                    ("query", "key", "value"), self.project.weight.chunk(3), self.project.bias.chunk(3), strict=True
                )
            ]
            seen = build.add(RowAttention, "attention", *qkv, rows=rows, size=wide)
            seen = build.add(Dense, "gather", seen, weight=self.gather.weight, bias=self.gather.bias, rows=rows)
            total = build.combine("sum", BinaryOperation.ADD, x, seen)
            gain, shift, epsilon = self.norm.weight, self.norm.bias, self.norm.eps
            return build.add(LayerNorm, "norm", total, gain=gain, shift=shift, epsilon=epsilon, rows=rows)

    def costs(self) -> list[Cost]:
        rows, wide = self.outputs, self.hidden
        return [
            Cost(
                f"attention across {rows} outputs",
                parameters_of(self),
                # Scores and weighted sums over the outputs cost `rows^2 C` each; four projections cost `rows C^2` each.
                per_prediction=4 * rows * wide * wide + 2 * rows * rows * wide,
                width_in=rows * wide,
                width_out=3 * rows * wide,
                per_time_step=False,
            )
        ]
