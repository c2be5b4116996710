"""Reptile: towards the weights that each machine would have (Nichol et al. 2018, arXiv 1803.02999)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from edp.errors import ConfigError
from edp.networks.predictor import Predictor
from edp.training.adaptation import Pieces, adapt, loss_with
from edp.training.objective import Objective
from edp.training.pretraining.meta import Meta
from edp.training.pretraining.methods.base import PRETRAININGS
from edp.training.pretraining.spec import MetaSpec
from edp.training.strategy import TrainingStrategy


@PRETRAININGS.register("reptile")
class Reptile:
    """Go the way from the weights to those after adaptation; the steps take support and query in turn."""

    label: ClassVar[str] = "Reptile"
    episodic: ClassVar[bool] = True

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy | None:
        """Return the episodes without derivatives of the adaptation.

        Raises:
            ConfigError: only the head adapts, or there is one step: nothing else would learn, or nothing be new.
        """
        if spec.head_only or spec.inner_steps < 2:
            raise ConfigError(
                f"reptile: head_only = {spec.head_only}, inner_steps = {spec.inner_steps}; what does not adapt does "
                "not learn, and one step is joint training: head_only off and inner_steps of at least 2 must hold"
            )
        return Towards(spec, start)


class Towards(Meta):
    """The gradient is the way that adaptation went, ``(w - w') / (sum of the rates)``."""

    def cost(self, net: Predictor, objective: Objective, support: Pieces, query: Pieces) -> Tensor:
        """Return the query's loss after adaptation, whose gradient is replaced by the Reptile gradient."""
        start = self.start_of(net)
        weights = start
        for number, rate in enumerate(self.spec.steps):
            # Support and query in turn: Reptile learns from all pieces alike.
            weights = adapt(net, weights, objective, query if number % 2 else support, (rate,))
        with torch.no_grad():
            value = loss_with(net, weights, objective, query)
        # The sum of the rates turns the way back into the size of a gradient.
        scale = sum(self.spec.steps)
        way = [((tensor - weights[name]).detach() / scale * tensor).sum() for name, tensor in start.items()]
        path = torch.stack(way).sum()
        # The value is the query's loss, the gradient is that of the path: a difference with itself adds zero.
        return value + path - path.detach()
