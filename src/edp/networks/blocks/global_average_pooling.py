"""Global average pooling: the mean recurrent state over the window as additional features (eq. 3.19)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Dense
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of
from edp.networks.trailing import StreamingTrailingMean


@BLOCKS.register("global_average_pooling")
@dataclass(frozen=True, kw_only=True)
class GlobalAveragePooling:
    """Concatenate the mean of the states over the trailing window, projected to half their width.

    At the last tick of a window from reset this is the thesis's mean over the whole window.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.FEATURES
    space: ClassVar[dict[str, object]] = {}

    def extra(self, width: int) -> int:
        """Return the number of features added for recurrent states of `width`."""
        # At least one feature, so that a single unit does not give an empty layer.
        return max(1, width // 2)

    def build(self, width: int, window: int) -> Streaming:
        """Build the pooling branch."""
        return _Pooling(width, window, self.extra(width))


class _Pooling(Streaming):
    operations = frozenset({Operation.LINEAR})

    def __init__(self, width: int, window: int, extra: int) -> None:
        super().__init__()
        self.mean = StreamingTrailingMean(width, window)
        self.project = nn.Linear(width, extra)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return self.mean.initial_state(batch, like)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        mean, state = self.mean(x, state)
        return self.project(mean), state

    def lower(self, build: Builder, x: str) -> str:
        with build.inside("average"):
            mean = self.mean.lower(build, x)
            return build.add(Dense, "projection", mean, weight=self.project.weight, bias=self.project.bias)

    def costs(self) -> list[Cost]:
        into, out = self.project.in_features, self.project.out_features
        own = Cost(
            f"global average pooling {into}->{out}",
            parameters_of(self.project),
            per_prediction=into * out,
            width_in=into,
            width_out=out,
            per_time_step=False,
        )
        return [*self.mean.costs(), own]
