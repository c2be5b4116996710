"""Slots: where an optional structural module sits in the network, and the tensor contract it keeps there."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import ClassVar, Protocol, runtime_checkable

from edp.registry import Registry
from edp.streaming import Streaming


class Slot(StrEnum):
    """Tensor contract of a block.

    BRANCHES: scaled features ``(batch, time, feature)`` to ``(batch, time, channel)`` by several convolution stacks.
    FEATURES: recurrent states ``(batch, time, width)`` to further features ``(batch, time, extra)``, concatenated.
    GATE: representation ``(batch, time, width)`` to one per output, ``(batch, time, output, width)``.
    BYPASS: scaled features to ``(batch, time, horizon, output)``, added to the network's standardised output.
    """

    BRANCHES = "branches"
    FEATURES = "features"
    GATE = "gate"
    BYPASS = "bypass"


BranchMaker = Callable[[int], Streaming]
"""Builds one convolution stack whose first dilation is the argument."""


@runtime_checkable
class BlockSpec(Protocol):
    """A frozen dataclass of a block's options; a subclass-free interface, one per slot adds `build`."""

    slot: ClassVar[Slot]


class BranchesSpec(BlockSpec, Protocol):
    """A block that replaces the single convolution stack."""

    def build(self, make_branch: BranchMaker) -> Streaming: ...


class FeaturesSpec(BlockSpec, Protocol):
    """A block that adds features derived from the recurrent states."""

    def extra(self, width: int) -> int: ...

    def build(self, width: int) -> Streaming: ...


class GateSpec(BlockSpec, Protocol):
    """A block that gives each output its own view of the representation."""

    def build(self, width: int, outputs: int) -> Streaming: ...


class BypassSpec(BlockSpec, Protocol):
    """A block that adds a direct path from the scaled features to the output."""

    def build(self, features: int, horizons: int, outputs: int) -> Streaming: ...


BLOCKS: Registry[type] = Registry("block")
