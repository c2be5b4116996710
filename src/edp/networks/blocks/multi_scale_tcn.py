"""Multi-scale TCN: a fine and a coarse convolution stack side by side (thesis 3.2.2.2 and 3.2.3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.errors import ConfigError
from edp.ir import Builder
from edp.networks.blocks.base import BLOCKS, BlockSlot, BranchMaker
from edp.networks.streaming import Cost, State, Streaming
from edp.settings.bounds import MAX_LEVELS, MOST_TICKS, check_bounds, check_count, integer


@BLOCKS.register("multi_scale_tcn")
@dataclass(frozen=True, kw_only=True)
class MultiScaleTcn:
    """Run convolution stacks with different first dilations and concatenate their channels.

    The fine stack (1, 2, 4, ...) sees pressure transients, the coarse one (4, 8, 16, ...) slower load trends.

    Attributes:
        first_dilations: first dilation of each stack.

    Raises:
        ConfigError: fewer than two stacks, or a dilation below 1.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.BRANCHES
    space: ClassVar[dict[str, object]] = {"first_dilations": ((1, 4), (1, 8))}
    first_dilations: tuple[int, ...] = (1, 4)

    def __post_init__(self) -> None:
        check_count("multi_scale_tcn", "first_dilations", self.first_dilations, MAX_LEVELS)
        check_bounds("multi_scale_tcn", self, first_dilations=integer(1, MOST_TICKS))
        if len(self.first_dilations) < 2 or min(self.first_dilations) < 1:
            raise ConfigError(
                f"multi_scale_tcn: first_dilations = {list(self.first_dilations)}; "
                "give two or more dilations of at least 1, for example [1, 4]"
            )

    def build(self, make_branch: BranchMaker) -> Streaming:
        """Build the parallel stacks; the output width is the sum of their widths."""
        return _Parallel([make_branch(dilation) for dilation in self.first_dilations])


class _Parallel(Streaming):
    def __init__(self, branches: list[Streaming]) -> None:
        super().__init__()
        self.branches = nn.ModuleList(branches)

    def _streams(self) -> list[Streaming]:
        return [branch for branch in self.branches if isinstance(branch, Streaming)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        return tuple(branch.initial_state(batch, like) for branch in self._streams())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        results = [branch(x, old) for branch, old in zip(self._streams(), state, strict=True)]
        return torch.cat([y for y, _ in results], dim=-1), tuple(new for _, new in results)

    def lower(self, build: Builder, x: str) -> str:
        branch_values = []
        for number, branch in enumerate(self._streams(), start=1):
            with build.inside(f"scale{number}"):
                branch_values.append(branch.lower(build, x))
        return build.join("scales", *branch_values)

    def costs(self) -> list[Cost]:
        return [cost for branch in self._streams() for cost in branch.costs()]
