"""The thesis's fine-tuning: the head first, then everything at discriminative rates (3.4.4)."""

from __future__ import annotations

from typing import ClassVar

from edp.networks.decomposition import decompose
from edp.training.bundle import weights_digest
from edp.training.optimizers import AdamW, Discriminative
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of


@METHODS.register("two_phase")
class TwoPhase:
    """Phase 1 trains the head alone, phase 2 everything, the backbone at a much smaller rate (Table 3.1)."""

    label: ClassVar[str] = "Fine-tuned, two phases"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Both phases; the first is a run of its own within the run of the second."""
        spec, parts = case.spec, decompose(case.source.predictor)
        # 0.999 is AdamW's usual value; the library's default of 0.99 is for short runs.
        heads = AdamW(learning_rate=spec.head_rate, weight_decay=spec.weight_decay, beta2=0.999)
        warmed = case.train(
            "two_phase, head",
            case.tuning(heads, spec.head_epochs),
            lambda: WarmStart(case.source.predictor, parts.encoding),
            phase="head",
        )
        # Depth counts from the head: layers near the input change least.
        above = list(reversed(parts.backbone))
        rates = tuple((part, spec.backbone_rate * spec.depth_decay**depth) for depth, part in enumerate(above))
        optimizer = Discriminative(rates=rates, learning_rate=spec.head_rate, weight_decay=spec.weight_decay)
        start = {"start": weights_digest(warmed)}
        network = case.train("two_phase", case.tuning(optimizer, spec.epochs), lambda: WarmStart(warmed), start)
        return of_network(network, size_of(network))
