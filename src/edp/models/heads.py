"""Per-output heads: one small network for each target on the shared representation (eq. 3.25, 3.26)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from edp.errors import ConfigError
from edp.streaming import Cost, State, Streaming, parameters_of


@dataclass(frozen=True, kw_only=True)
class HeadSpec:
    """Options of the heads.

    Attributes:
        hidden: width d' of the hidden layers.
        layers: hidden layers; 1 is the thesis's baseline, 2 its deeper head.

    Raises:
        ConfigError: a width or depth below 1.
    """

    hidden: int = 32
    layers: int = 1

    def __post_init__(self) -> None:
        if self.hidden < 1 or self.layers < 1:
            raise ConfigError(f"head: hidden = {self.hidden}, layers = {self.layers}; both must be at least 1")

    def build(self, width: int, outputs: int, horizons: int) -> Heads:
        """Heads from a representation of `width`."""
        return Heads(width, outputs, horizons, self)


class Heads(Streaming):
    """``y_c = w_c ReLU(W_c h + b_c) + b'_c`` for every output c at once.

    Maps ``(batch, time, width)`` (shared) or ``(batch, time, output, width)`` (gated) to
    ``(batch, time, horizon, output)``.
    """

    def __init__(self, width: int, outputs: int, horizons: int, spec: HeadSpec) -> None:
        super().__init__()
        widths = [width] + [spec.hidden] * spec.layers + [horizons]
        self.outputs, self.widths = outputs, widths
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(outputs, into, out)) for into, out in pairwise(widths))
        self.biases = nn.ParameterList(nn.Parameter(torch.empty(outputs, out)) for out in widths[1:])
        with torch.no_grad():
            for weight, bias in zip(self.weights, self.biases, strict=True):
                bound = 1.0 / math.sqrt(weight.shape[1])
                weight.uniform_(-bound, bound)
                bias.uniform_(-bound, bound)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        batch, time = x.shape[:2]
        if x.ndim == 3:
            shared = self.weights[0].transpose(0, 1).flatten(1)
            y = (x @ shared).unflatten(-1, (self.outputs, -1)) + self.biases[0]
        else:
            y = self._layer(0, x)
        for layer in range(1, len(self.weights)):
            y = self._layer(layer, torch.relu(y))
        return y.reshape(batch, time, self.outputs, -1).transpose(2, 3), state

    def _layer(self, layer: int, x: Tensor) -> Tensor:
        """``(batch, time, output, in)`` to ``(batch, time, output, out)``."""
        return torch.einsum("btci,cio->btco", x, self.weights[layer]) + self.biases[layer]

    def costs(self) -> list[Cost]:
        return [
            Cost(
                f"heads, {self.outputs} x {'-'.join(map(str, self.widths))}",
                parameters_of(self),
                per_prediction=sum(weight.numel() for weight in self.weights),
                width_in=self.widths[0],
                width_out=self.outputs * max(self.widths[1:]),
                per_time_step=False,
            )
        ]
