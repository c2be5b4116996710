"""Inner loop of meta-learning: plain gradient descent on a few segments, as a function of the weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from edp.networks.predictor import Predictor
from edp.networks.streaming import State
from edp.training.objective import Objective

Weights = dict[str, Tensor]
Pieces = tuple[Tensor, Tensor, Tensor]
"""Inputs ``(batch, time, input)`` and future targets ``(batch, time, horizon, target)`` in SI units, validity."""


class _Exposed(nn.Module):
    """Wrapper that makes `Predictor.expose` the call of a module, so that it can be evaluated with other weights."""

    def __init__(self, net: Predictor) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor, state: State) -> tuple[Any, Tensor, Tensor, State]:
        return self.net.forward_features(x, state)


def loss_with(net: Predictor, weights: Mapping[str, Tensor], objective: Objective, pieces: Pieces) -> Tensor:
    """Return the loss of a network with other weights on segments from reset.

    Args:
        net: the network.
        weights: weights by parameter name; missing ones are those of the network.
        objective: the loss.
        pieces: segments for the loss.
    """
    x, future, valid = pieces
    with torch.no_grad():
        state = net.initial_state(len(x), x)
    named = {f"net.{name}": tensor for name, tensor in weights.items()}
    answer, features, _, _ = functional_call(_Exposed(net), named, (x, state))
    return objective.evaluate(answer, future, features, valid)


def adapt(
    net: Predictor,
    start: Weights,
    objective: Objective,
    support: Pieces,
    steps: Sequence[float],
    second_order: bool = False,
) -> Weights:
    """Return ``w <- w - rate * gradient of the support's loss``, once for each rate of `steps`.

    Args:
        net: the network.
        start: the weights that adapt, by name; all others stay.
        objective: the loss.
        support: the segments to adapt on.
        steps: the rate of each step.
        second_order: keep what a gradient through the steps needs, through their gradients too. Without it the
            result depends on `start` by nothing but the sum, as first-order methods take it.
    """
    weights = start
    for rate in steps:
        loss = loss_with(net, weights, objective, support)
        # Parameters that the support does not touch, such as frozen ones, have no gradient and stay.
        gradients = torch.autograd.grad(loss, list(weights.values()), create_graph=second_order, allow_unused=True)
        weights = {
            name: tensor if slope is None else tensor - rate * slope
            for (name, tensor), slope in zip(weights.items(), gradients, strict=True)
        }
    return weights
