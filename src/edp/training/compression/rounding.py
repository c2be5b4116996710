"""Rounding of weights and their inputs, inserted into an otherwise unchanged network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from edp.data.series import Series
from edp.networks.heads import GatedUnit, Heads
from edp.networks.matrices import Matrix, matrices_of
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions

LEVELS = 127  # of an 8-bit weight to both sides of zero
# A network that is trained on may come to larger values than it had: with 16 bits two of them are spent on that.
HEADROOM = 4.0
# With 8 bits large and rare values are cut off for the sake of the others: which share of the range loses least.
SHARES = tuple(2.0**-power for power in range(7))
PIECE = 2048  # ticks of each series that ranges are found on


def weight_levels(weight: Tensor, axes: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return 8-bit levels of a weight, from -127 to 127, and the step of each output, which broadcasts against them.

    The step is the largest magnitude of the output's weights over 127, so weights that were rounded once have the same
    levels again.
    """
    others = [axis for axis in range(weight.ndim) if axis not in axes]
    # The floor serves rows of zeros, which have no step.
    steps = weight.abs().amax(dim=others, keepdim=True).clamp(min=1e-30) / LEVELS
    return (weight / steps).round(), steps


class _StraightThrough(torch.autograd.Function):
    """Rounded values with the gradient of those that were rounded."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rounded: Tensor) -> Tensor:
        # Rounding has zero slope almost everywhere; its gradient is taken as one (straight-through estimator).
        return rounded

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad, None


def _pass_gradient(values: Tensor, rounded: Tensor) -> Tensor:
    result: Tensor = _StraightThrough.apply(values, rounded.detach())  # type: ignore[no-untyped-call]
    return result


class Site:
    """Values at one place of a network: how large they become, then rounded to a fixed grid.

    Args:
        bits: bits of a value, including the sign.
    """

    def __init__(self, bits: int) -> None:
        self.levels = 2 ** (bits - 1) - 1
        self.shares = (HEADROOM,) if bits > 8 else SHARES
        self.largest = 0.0
        self.errors: Tensor | None = None
        self.limit: float | None = None

    def __call__(self, x: Tensor) -> Tensor:
        """Return the values, rounded once the range is fixed."""
        if self.limit is not None:
            # Outside of the range the clamp has no gradient: values there should not grow further.
            inside = x.clamp(-self.limit, self.limit)
            return _pass_gradient(inside, self._round(x, self.limit))
        if self.errors is None:
            self.largest = max(self.largest, float(x.detach().abs().max()))
        else:
            self.errors += torch.tensor(
                [float((self._round(x, share * self.largest) - x).square().sum()) for share in self.shares]
            )
        return x

    def _round(self, x: Tensor, limit: float) -> Tensor:
        # Symmetric levels, as in the exported integer code.
        step = limit / self.levels
        rounded: Tensor = (x / step).round().clamp(-self.levels, self.levels) * step
        return rounded

    def compare(self) -> None:
        """Start to search for the range with the least loss."""
        self.largest = self.largest or 1.0
        self.errors = torch.zeros(len(self.shares))

    def settle(self) -> None:
        """End the search and start to round."""
        best = 0 if self.errors is None else int(self.errors.argmin())
        self.limit = self.shares[best] * self.largest


class NetworkRounding:
    """Rounding within a network: `install` puts it in, `remove` takes it out, `keep` leaves the weights rounded.

    Weights are rounded to 8 bits, symmetric about zero, with a step for each output. Their gradients are those of the
    rounded ones and move the others. What a weighted part reads is rounded to a fixed grid, tick by tick, so a stream,
    a chunk and a window see the same numbers. What a recurrent layer hands to its own next tick is not rounded.

    Args:
        network: the network.
        activation_bits: bits of the inputs of weighted parts; 0 for no rounding.
        recurrent: False leaves the matrices of recurrent layers as they are.
    """

    def __init__(self, network: Predictor, activation_bits: int, recurrent: bool = True) -> None:
        self.network, self.bits = network, activation_bits
        self.matrices = matrices_of(network, recurrent)
        self.sites: list[Site] = []
        self._handles: list[Any] = []
        self._units: dict[Heads, tuple[GatedUnit, ...]] = {}

    def install(self, series: Sequence[Series]) -> None:
        """Find the ranges of what parts read on the beginnings of these series, in float, then round."""
        if self.bits:
            for part in dict.fromkeys(matrix.part for matrix in self.matrices):
                self._watch(part)
            # The beginnings of all series give ranges of every kind of work at little cost.
            some = [
                replace(one, inputs=one.inputs[:PIECE], targets=one.targets[:PIECE], strategy_columns=None)
                for one in series
            ]
            stream_predictions(self.network, some)
            for site in self.sites:
                site.compare()
            # With 16 bits a single share is tried, and the second pass would choose nothing.
            if any(len(site.shares) > 1 for site in self.sites):
                stream_predictions(self.network, some)
            for site in self.sites:
                site.settle()
        for part in dict.fromkeys(matrix.part for matrix in self.matrices):
            self._swap([matrix for matrix in self.matrices if matrix.part is part], part)

    def remove(self) -> None:
        """Leave the network as it was before `install`, with the weights that it has now."""
        for handle in self._handles:
            handle.remove()
        for heads, units in self._units.items():
            heads.units = units
        for matrix in self.matrices:
            if isinstance(matrix.part, nn.LSTM):  # it holds what it was last called with
                matrix.part._init_flat_weights()
        self._handles, self._units, self.sites = [], {}, []

    def keep(self) -> None:
        """Replace the weights by their rounded values."""
        with torch.no_grad():
            for matrix in self.matrices:
                levels, steps = weight_levels(matrix.values, matrix.axes)
                matrix.values.copy_(levels * steps)

    def _swap(self, matrices: list[Matrix], part: nn.Module) -> None:
        """Let a part compute with rounded weights whenever it is called."""
        replaced = [(matrix.holder._parameters, matrix.key, matrix.values, matrix.axes) for matrix in matrices]

        # Before the call the parameter is a rounded tensor, whose gradient flows to the real one.
        def enter(*_: object) -> None:
            for parameters, key, weight, axes in replaced:
                levels, steps = weight_levels(weight.detach(), axes)
                parameters[key] = _pass_gradient(weight, levels * steps)  # type: ignore[assignment]

        def leave(*_: object) -> None:
            for parameters, key, weight, _axes in replaced:
                parameters[key] = weight  # type: ignore[assignment]

        self._handles.append(part.register_forward_pre_hook(enter))
        # Called even after an error, so that the network never keeps rounded weights.
        self._handles.append(part.register_forward_hook(leave, always_call=True))

    def _watch(self, part: nn.Module) -> None:
        """Round the inputs of a part; for heads, the inputs of each layer."""
        site = self._site()
        self._handles.append(
            part.register_forward_pre_hook(lambda module, arguments: (site(arguments[0]), *arguments[1:]))
        )
        if not isinstance(part, Heads):
            return
        self._units[part] = part.units
        sites = [self._site() for _ in part.units]
        units = [_append_site(unit, after) for unit, after in zip(part.units, sites, strict=True)]
        if part.mix is not None:  # it stands between the last unit and the last layer
            units[-1] = part.units[-1]
            last = sites[-1]
            hook = part.mix.register_forward_hook(lambda module, arguments, result: (last(result[0]), result[1]))
            self._handles.append(hook)
        part.units = tuple(units)

    def _site(self) -> Site:
        self.sites.append(Site(self.bits))
        return self.sites[-1]


def _append_site(unit: GatedUnit, site: Site) -> GatedUnit:
    return replace(unit, apply=lambda x: site(unit.apply(x)))
