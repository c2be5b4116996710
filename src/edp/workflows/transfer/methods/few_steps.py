"""The inner loop of meta-learning as a fine-tuning: a few steps of plain gradient descent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

from edp.networks.decomposition import decompose
from edp.training.averages import NoAverage
from edp.training.optimizers import Sgd
from edp.training.schedules import Constant
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods.base import METHODS, Made, of_network, size_of

RATE = 0.5
"""Of sources that were not meta-learned."""


@METHODS.register("few_steps")
class FewSteps:
    """Steps of gradient descent at the rate of the source's meta-learning, each an epoch that may be the best one."""

    label: ClassVar[str] = "A few steps"
    trains: ClassVar[bool] = True
    needs_source: ClassVar[bool] = False
    needs_code: ClassVar[bool] = False

    def make(self, case: TransferCase) -> Made:
        """Take the steps; what did not adapt in the meta-learning does not here."""
        spec, source = case.spec, case.source
        meta: Mapping[str, Any] = (source.bundle.provenance.get("strategy") or {}).get("meta") or {}
        rate = spec.inner_rate or float(meta.get("inner_rate", RATE))
        frozen = decompose(source.predictor).encoding if meta.get("head_only") else ()
        training = replace(
            case.tuning(Sgd(learning_rate=rate), spec.inner_steps),
            # Plain descent at a constant rate without an average: what meta-learning trained for.
            terms=case.experiment.training.terms,
            schedule=Constant(),
            average=NoAverage(),
            # One update over all logs makes each step an epoch, which validation can choose.
            updates=1,
        )
        network = case.train("few_steps", training, lambda: WarmStart(source.predictor, frozen), centred=False)
        names = [name for name, _ in network.named_parameters() if name not in frozen]
        return of_network(network, size_of(network, names))
