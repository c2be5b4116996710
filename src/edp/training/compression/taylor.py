"""Importance of each channel, recurrent unit and hidden feature of a network on data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from edp.data.series import Series
from edp.errors import DataError
from edp.networks.cells import Stack
from edp.networks.convolution import CausalConv, TemporalBlock
from edp.networks.predictor import Predictor
from edp.networks.streaming import detach_state

# Short pieces bound the memory of the backward pass; many of them cover every kind of work.
PIECE = 256


@dataclass(frozen=True, eq=False)
class FeatureImportance:
    """Squared first-order change of the loss when a feature is set to zero, averaged over segments of the data.

    Attributes:
        sites: importance by module, ``(channel,)`` or ``(unit,)``: convolutions, temporal blocks and recurrent layers.
        hidden: importance of the heads' hidden layers, each ``(output, feature)``.
    """

    sites: dict[nn.Module, Tensor]
    hidden: list[Tensor]


def importance(predictor: Predictor, series: Sequence[Series], pieces: int = 64) -> FeatureImportance:
    """Measure a network on series with truth (the Taylor criterion of Molchanov et al. 2017, arXiv 1611.06440).

    For a feature a it is ``(sum over ticks of a dL/da)^2``, L the mean squared standardised error of a piece.

    Args:
        predictor: the network; left as it was.
        series: data to measure on, usually those it was trained on.
        pieces: maximum number of evenly spaced segments of 256 samples.

    Raises:
        DataError: no series is longer than the largest horizon.
    """
    by_module: dict[nn.Module, Tensor] = {}
    hidden = [torch.zeros(weight.shape[0], 0) for weight in predictor.heads.weights[:-1]]
    chosen = _pieces(predictor, series, pieces)
    with _record_outputs(predictor) as outputs:
        for part, start, stop in chosen:
            predictor.zero_grad(set_to_none=True)
            _loss(predictor, part, start, stop).backward()
            for module, value in outputs.items():
                if value.grad is not None:
                    # The sum over ticks before the square: a feature counts by its effect on the whole piece.
                    change = (value * value.grad).sum(dim=(0, 1)).detach().square()
                    by_module[module] = by_module.get(module, torch.zeros_like(change)) + change
            for layer, change in enumerate(_compute_sensitivities(predictor)):
                hidden[layer] = change.square() + (hidden[layer] if hidden[layer].numel() else 0.0)
    predictor.zero_grad(set_to_none=True)
    return FeatureImportance(by_module, hidden)


def _pieces(predictor: Predictor, series: Sequence[Series], most: int) -> list[tuple[Series, int, int]]:
    reach = predictor.task.max_horizon
    every = [
        (part, start, min(start + PIECE, part.samples - reach))
        for part in series
        for start in range(0, part.samples - reach, PIECE)
    ]
    if not every:
        raise DataError(f"pruning: no series is longer than the horizon of {reach} ticks; give longer recordings")
    # Even distances over all recordings; drawing would make importance depend on chance.
    chosen = np.unique(np.linspace(0, len(every) - 1, min(most, len(every))).round().astype(int))
    return [every[i] for i in chosen]


def _loss(predictor: Predictor, part: Series, start: int, stop: int) -> Tensor:
    """Return the mean squared standardised error of a segment, after a window of lead from reset."""
    # A window of lead, so that the state is that of a stream and not of a reset.
    lead = max(0, start - predictor.spec.window)
    like = next(predictor.parameters())
    x = torch.from_numpy(part.inputs[lead:stop]).unsqueeze(0).to(like)
    state = predictor.initial_state(1, x)
    if start > lead:
        with torch.no_grad():
            _, _, state = predictor.run(x[:, : start - lead], state)
    # Gradients end at the piece: the lead only sets the state.
    answer, features, _ = predictor.run(x[:, start - lead :], detach_state(state))
    future = np.stack([part.targets[start + k : stop + k] for k in predictor.task.horizons], axis=1)
    target = predictor.code.encode(torch.from_numpy(future).unsqueeze(0).to(like), features)
    return (answer.center - target).square().mean()


@contextmanager
def _record_outputs(predictor: Predictor) -> Iterator[dict[nn.Module, Tensor]]:
    """Record the last output of each convolution, temporal block and recurrent layer, with its gradient."""
    outputs: dict[nn.Module, Tensor] = {}

    def keep(module: nn.Module, _: object, result: tuple[Tensor, object]) -> None:
        if result[0].requires_grad:
            result[0].retain_grad()
            outputs[module] = result[0]

    layers = [layer for stack in predictor.modules() if isinstance(stack, Stack) for layer in stack.layers]
    levels = [part for part in predictor.modules() if isinstance(part, CausalConv | TemporalBlock)]
    hooks = [module.register_forward_hook(keep) for module in [*levels, *layers]]
    was_training = predictor.training
    predictor.eval()
    try:
        yield outputs
    finally:
        predictor.train(was_training)
        for hook in hooks:
            hook.remove()


def _compute_sensitivities(predictor: Predictor) -> list[Tensor]:
    """Return ``sum over ticks of z dL/dz`` of each hidden layer's features, from the gradients of what makes them.

    For ``z = W h + b`` it equals ``sum W dL/dW + b dL/db``; of a gated unit the first half alone makes the feature
    proportional to it.
    """
    heads = predictor.heads
    changes = []
    for weight, bias, width in zip(heads.weights, heads.biases, heads.widths[1:-1], strict=False):
        if weight.grad is None or bias.grad is None:
            continue
        # Weights times gradients give z dL/dz of the features that they make, without a hook inside the head.
        total = (weight * weight.grad).sum(dim=1) + bias * bias.grad
        changes.append(total[:, :width].detach())
    return changes
