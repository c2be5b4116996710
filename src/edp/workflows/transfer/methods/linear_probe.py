"""Linear probe: only the last linear layer of the heads learns."""

from __future__ import annotations

from typing import ClassVar

from edp.networks.decomposition import decompose
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of


@METHODS.register("linear_probe")
class LinearProbe:
    """A new linear read-out of the source's features; all below it is held."""

    label: ClassVar[str] = "Linear probe"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train the last layer."""
        parts = decompose(case.source.predictor)
        frozen = {*parts.encoding, *parts.head} - {*parts.last}
        network = case.train("linear_probe", case.tuning(), lambda: WarmStart(case.source.predictor, frozen))
        return of_network(network, size_of(network, parts.last))
