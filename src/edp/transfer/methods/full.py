"""Full fine-tuning: everything learns at one rate."""

from __future__ import annotations

from typing import ClassVar

from edp.transfer.case import Case
from edp.transfer.lessons import GoOn
from edp.transfer.methods.base import METHODS, Made, of_network, size_of


@METHODS.register("full")
class Full:
    """All parameters from the first update on, at one rate."""

    label: ClassVar[str] = "Fine-tuned, one rate"
    trains: ClassVar[bool] = True
    replays: ClassVar[bool] = False

    def make(self, case: Case) -> Made:
        """Train everything."""
        network = case.train("full", case.tuning(), lambda: GoOn(case.source.predictor))
        return of_network(network, size_of(network))
