"""Full fine-tuning: everything learns at one rate."""

from __future__ import annotations

from typing import ClassVar

from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of


@METHODS.register("full")
class Full:
    """All parameters from the first update on, at one rate."""

    label: ClassVar[str] = "Fine-tuned, one rate"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Train everything."""
        network = case.train("full", case.tuning(), lambda: WarmStart(case.source.predictor))
        return of_network(network, size_of(network))
