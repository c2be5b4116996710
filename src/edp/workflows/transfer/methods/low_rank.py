"""Low-rank adapters: a change of low rank for each weight matrix."""

from __future__ import annotations

from typing import ClassVar

from edp.networks.matrices import matrices_of
from edp.training.transfer.strategies import LowRank
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network


@METHODS.register("low_rank")
class Adapters:
    """Every weight matrix plus a learned product of two narrow ones, added to it at the end."""

    label: ClassVar[str] = "Low-rank adapters"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train the changes."""
        rank = case.spec.rank
        network = case.train(
            "low_rank", case.tuning(), lambda: LowRank(case.source.predictor, rank), {"rank": rank}, centred=False
        )
        return of_network(network, sum(change_size(m.values.shape, m.axes, rank) for m in matrices_of(network)))


def change_size(shape: tuple[int, ...], axes: tuple[int, ...], rank: int) -> int:
    """Parameters of a change of a weight of this shape whose outputs lie along `axes`."""
    rows = columns = 1
    for axis, size in enumerate(shape):
        rows, columns = (rows * size, columns) if axis in axes else (rows, columns * size)
    # A rank beyond the smaller side brings no further change.
    return min(rank, rows, columns) * (rows + columns)
