"""Velocity skip: the network learns the change from the present value of each target (eq. 3.24)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import ScaleShift
from edp.networks.blocks.base import BLOCKS, BlockSlot, ModelView, OutputSpace, TaskView
from edp.networks.streaming import Cost, State, Streaming


@BLOCKS.register("velocity_skip")
@dataclass(frozen=True, kw_only=True)
class VelocitySkip:
    """Add the present value of each target to the output, outside the output activation: ``v[t] + g(f(X))``.

    It is added in the standardised space of the target, whose mean and spread at each horizon are those of the scaler.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.BYPASS
    space: ClassVar[dict[str, object]] = {}

    def conflicts(self, model: ModelView, task: TaskView) -> str | None:
        """Return the delta mode and a physics base add the velocity already, and its present value must be known."""
        if task.mode == "delta":
            return (
                "velocity_skip adds the present value to the prediction, which mode = 'delta' does already; "
                "remove the block or set task.mode = 'absolute'"
            )
        if model.physics is not None:
            return (
                "velocity_skip adds the present value to a prediction to which the physics base adds the velocity "
                "already; remove the block or model.physics"
            )
        blind = [name for name, column in zip(task.targets, task.present, strict=True) if column is None]
        if blind:
            return (
                f"velocity_skip needs the present value of every target, and {', '.join(blind)} is not among the "
                "features; add it to the features or remove the block"
            )
        return None

    def build(self, space: OutputSpace) -> Streaming:
        """Build the skip connection.

        Raises:
            ConfigError: a target that is not a feature.
        """
        columns = [column for column in space.present if column is not None]
        if len(columns) < space.outputs:
            raise ConfigError(
                f"velocity_skip: {space.outputs - len(columns)} of {space.outputs} targets are not features; "
                "the present value of every target must be known"
            )
        return _Skip(columns, space)


class _Skip(Streaming):
    gain: Tensor
    shift: Tensor

    def __init__(self, columns: list[int], space: OutputSpace) -> None:
        super().__init__()
        self.columns = columns
        # Buffers, not parameters: the path must stay the present value itself, and bundles carry its scaling.
        self.register_buffer("gain", space.gain)
        self.register_buffer("shift", space.shift)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        return x[..., None, self.columns] * self.gain + self.shift, state

    def lower(self, build: Builder, x: str) -> str:
        with build.inside("skip"):
            present = build.pick("present", x, self.columns * len(self.gain))
            return build.add(ScaleShift, "scaled", present, gain=self.gain.flatten(), shift=self.shift.flatten())

    def costs(self) -> list[Cost]:
        wide = self.gain.numel()
        return [Cost("velocity skip", 0, width_in=len(self.columns), width_out=wide, per_time_step=False)]
