"""Direct transfer: the source's network as it is."""

from __future__ import annotations

from typing import ClassVar

from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network


@METHODS.register("direct")
class Direct:
    """The network of the source with its own scaling, not trained on (4.4.1)."""

    label: ClassVar[str] = "Direct transfer"
    trains: ClassVar[bool] = False
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Nothing is learned."""
        return of_network(case.source.predictor, 0)
