"""Slots: where an optional structural module sits in the network, and the tensor contract it keeps there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

from torch import Tensor

from edp.networks.streaming import Streaming
from edp.registry import Registry


class BlockSlot(StrEnum):
    """Tensor contract of a block, in the order of the computation.

    BRANCHES: scaled features ``(batch, time, feature)`` to ``(batch, time, channel)`` by several convolution stacks.
    CHANNELS: channels of the convolutions ``(batch, time, channel)`` to the same shape, before a recurrent layer.
    FEATURES: recurrent states ``(batch, time, width)`` to further features ``(batch, time, extra)``, concatenated.
    GATE: representation ``(batch, time, width)`` to one per output, ``(batch, time, output, width)``.
    MIX: hidden features of the heads ``(batch, time, output, hidden)`` to the same shape, before their last layer.
    BYPASS: scaled features to ``(batch, time, horizon, output)``, added to the network's standardised output.
    """

    BRANCHES = "branches"
    CHANNELS = "channels"
    FEATURES = "features"
    GATE = "gate"
    MIX = "mix"
    BYPASS = "bypass"


OUTPUT_SLOTS = (BlockSlot.GATE, BlockSlot.MIX, BlockSlot.BYPASS)
"""Block positions after the backbone, which exist in every network."""
SHARED_SLOTS = (BlockSlot.CHANNELS, BlockSlot.FEATURES)
"""Block positions that accept several blocks, applied in the listed order. All other positions accept one block."""

BranchMaker = Callable[[int], Streaming]
"""Function that builds one convolution stack from its first dilation."""


@dataclass(frozen=True, eq=False)
class OutputSpace:
    """Sizes of the network's input and output, for blocks at the output.

    Attributes:
        features: scaled features.
        horizons: look-ahead times.
        outputs: targets.
        present: index of the feature with the present value of each target; None if the target is not measured.
        gain: ``(horizon, output)``; a present value in the standardised space of its target is its scaled feature
            times `gain` plus `shift`.
        shift: ``(horizon, output)``.
    """

    features: int
    horizons: int
    outputs: int
    present: tuple[int | None, ...]
    gain: Tensor
    shift: Tensor


@runtime_checkable
class BlockSpec(Protocol):
    """A frozen dataclass of a block's options; a subclass-free interface, one per slot adds `build`.

    Attributes:
        slot: position of the block in the network.
        space: values worth searching, by option; a block that has some is among the modules of every search.
    """

    slot: ClassVar[BlockSlot]
    space: ClassVar[dict[str, Any]]


class TaskView(Protocol):
    """Properties of a task that a part may check before it is built."""

    @property
    def mode(self) -> str: ...
    @property
    def targets(self) -> tuple[str, ...]: ...
    @property
    def present(self) -> tuple[int | None, ...]: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...


class ModelView(Protocol):
    """Properties of a model that a part may check before it is built."""

    @property
    def backbone(self) -> object: ...
    @property
    def head(self) -> object: ...
    @property
    def activation(self) -> object: ...
    @property
    def blocks(self) -> tuple[object, ...]: ...
    @property
    def physics(self) -> object | None: ...


@runtime_checkable
class HasConflicts(Protocol):
    """A part (block, backbone, head, activation) that does not go with everything."""

    def conflicts(self, model: ModelView, task: TaskView) -> str | None:
        """Return why this part contradicts the model or the task and what to change, None where it does not."""


BLOCKS: Registry[type] = Registry("block")
