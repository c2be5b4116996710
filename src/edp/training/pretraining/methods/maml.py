"""Model-agnostic meta-learning, second and first order (Finn et al. 2017, arXiv 1703.03400)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from edp.networks.predictor import Predictor
from edp.training.adaptation import Pieces, adapt, loss_with
from edp.training.objective import Objective
from edp.training.pretraining.meta import Meta
from edp.training.pretraining.methods.base import PRETRAININGS
from edp.training.pretraining.spec import MetaSpec
from edp.training.strategy import TrainingStrategy


@PRETRAININGS.register("maml")
class Maml:
    """Minimise the error after adaptation; the gradient goes through the steps of adaptation and their gradients."""

    label: ClassVar[str] = "MAML, second order"
    episodic: ClassVar[bool] = True

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy | None:
        """Return the episodes with second derivatives."""
        return AfterAdaptation(spec, start, second_order=True)


@PRETRAININGS.register("fomaml")
class FirstOrderMaml:
    """The same, but adaptation counts as adding a constant: no second derivatives."""

    label: ClassVar[str] = "MAML, first order"
    episodic: ClassVar[bool] = True

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy | None:
        """Return the episodes without second derivatives."""
        return AfterAdaptation(spec, start, second_order=False)


class AfterAdaptation(Meta):
    """``min over w of L_query(w - rate * gradient of L_support(w) - ...)``, mean over machines."""

    def __init__(self, spec: MetaSpec, start: Predictor | None, second_order: bool) -> None:
        super().__init__(spec, start)
        self.second_order = second_order

    def cost(self, net: Predictor, objective: Objective, support: Pieces, query: Pieces) -> Tensor:
        """Return the query's loss with adapted weights."""
        weights = adapt(net, self.start_of(net), objective, support, self.spec.steps, self.second_order)
        return loss_with(net, weights, objective, query)
