"""Per-output heads: one small network for each target on the shared representation (eq. 3.25 to 3.27)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Clip, Dense, Function, Glu, GroupedDense, ScaleShift
from edp.networks.streaming import Cost, Operation, State, Streaming
from edp.registry import Registry
from edp.settings.bounds import MAX_LAYERS, MAX_UNITS, check_bounds, integer


class HeadSpec(Protocol):
    """Options of the heads."""

    @property
    def hidden(self) -> int:
        """Width of the features before the last layer."""
        ...

    def build(self, width: int, outputs: int, values: int, mix: Streaming | None = None) -> Heads:
        """Build heads from a representation of `width` to `values` elements per output.

        `mix` works on the hidden features of all outputs before the last layer.
        """
        ...


HEADS: Registry[type] = Registry("head")


@HEADS.register("mlp")
@dataclass(frozen=True, kw_only=True)
class MlpHead:
    """``y_c = w_c ReLU(W_c h + b_c) + b'_c`` for each output c (eq. 3.26).

    Attributes:
        hidden: width d' of the hidden layers.
        layers: hidden layers; 1 is the thesis's baseline, 2 its deeper head.

    Raises:
        ConfigError: a width or depth below 1.
    """

    space: ClassVar[dict[str, object]] = {"hidden": (16, 32, 64, 128), "layers": (1, 2)}
    hidden: int = 32
    layers: int = 1

    def __post_init__(self) -> None:
        check_bounds("head", self, hidden=integer(1, MAX_UNITS), layers=integer(1, MAX_LAYERS))

    def build(self, width: int, outputs: int, values: int, mix: Streaming | None = None) -> Heads:
        """Return the heads with ReLU."""
        return Heads(width, outputs, values, [RELU] * self.layers, self.hidden, mix)


@HEADS.register("glu")
# A layer twice as wide feeds the gated unit, which halves it again.
@dataclass(frozen=True, kw_only=True)
class GluHead:
    """A head whose first layer is gated: ``GLU(u) = u_1 sigmoid(u_2)`` with ``u = W_c h + b_c`` (eq. 3.27).

    The two halves of u are as wide as the hidden layer, so W_c is twice as high as in the plain head. Further hidden
    layers are those of the deeper head, with ReLU.

    Attributes:
        hidden: width d' of the hidden layers.
        layers: hidden layers, the gated one included.

    Raises:
        ConfigError: a width or depth below 1.
    """

    space: ClassVar[dict[str, Any]] = {"hidden": (16, 32, 64, 128), "layers": (1, 2)}
    hidden: int = 32
    layers: int = 1

    def __post_init__(self) -> None:
        check_bounds("head", self, hidden=integer(1, MAX_UNITS), layers=integer(1, MAX_LAYERS))

    def build(self, width: int, outputs: int, values: int, mix: Streaming | None = None) -> Heads:
        """Return the heads that begin with a gated linear unit."""
        return Heads(width, outputs, values, [GATED] + [RELU] * (self.layers - 1), self.hidden, mix)


@HEADS.register("linear")
@dataclass(frozen=True, kw_only=True)
class LinearHead:
    """``y_c = w_c h + b_c`` for each output c: no hidden layer.

    Blocks that mix hidden features are rejected, because this head has none.

    Attributes:
        dead_band: whether small predictions are set to zero. Cross-validation selects the width per output
            (`OutputBand`).
    """

    dead_band: bool = False

    @property
    def hidden(self) -> int:
        """Return 1, the number of features without a hidden layer."""
        return 1

    def conflicts(self, model: Any, task: Any) -> str | None:
        """Return the conflict with a block on hidden features, which this head lacks."""
        if self.dead_band and model.output.values > 1:
            return "a dead band is one of predictions, and this output says more; take model.output = 'point'"
        mixing = [type(block).__name__ for block in model.blocks if getattr(block, "slot", None) == "mix"]
        if mixing:
            return f"the head 'linear' has no hidden features for the block {mixing[0]}; take the head 'mlp' or 'glu'"
        return None

    def build(self, width: int, outputs: int, values: int, mix: Streaming | None = None) -> Heads:
        """Return the heads of one linear layer."""
        return Heads(width, outputs, values, [], 1, mix, OutputBand(values, outputs) if self.dead_band else None)


class OutputBand(nn.Module):
    """``y - 2 clip(y, -b, b) + clip(y, -2b, 2b)``: zero up to b, twice as steep as y up to 2b, then y itself.

    Attributes:
        width: b of each number, ``(value, output)``, not negative; at first 0, which changes no bit of y.
    """

    width: Tensor

    def __init__(self, values: int, outputs: int) -> None:
        super().__init__()
        self.register_buffer("width", torch.zeros(values, outputs))

    def forward(self, y: Tensor) -> Tensor:
        """Apply the dead band to ``(..., value, output)``."""
        b = self.width
        return y - 2.0 * torch.clamp(y, -b, b) + torch.clamp(y, -2.0 * b, 2.0 * b)

    def lower(self, build: Builder, y: str) -> str:
        """Add the dead band to a graph, with values varying slowest; skip a dead band of zero width."""
        b = self.width.flatten()
        if not bool(b.any()):
            return y
        inner = build.add(Clip, "band.inner", y, low=-b, high=b)
        doubled = build.add(ScaleShift, "band.doubled", inner, gain=torch.full_like(b, -2.0), shift=torch.zeros_like(b))
        outer = build.add(Clip, "band.outer", y, low=-2.0 * b, high=2.0 * b)
        beyond = build.combine("band.beyond", BinaryOperation.ADD, y, doubled)
        return build.combine("band", BinaryOperation.ADD, beyond, outer)


@dataclass(frozen=True)
class GatedUnit:
    """Non-linearity after a linear layer that is `factor` times as wide as its output."""

    factor: int
    apply: Callable[[Tensor], Tensor]
    operation: Operation

    def lower(self, build: Builder, x: str, rows: int) -> str:
        """Add it to a graph, on each of `rows` rows."""
        size = build.width(x)
        if self.operation is Operation.GLU:
            return build.add(Glu, "gated", x, rows=rows, size=size // rows)
        return build.add(Activate, "relu", x, function=Function.RELU, size=size)


RELU = GatedUnit(1, torch.relu, Operation.RELU)
GATED = GatedUnit(2, functional.glu, Operation.GLU)


class Heads(Streaming):
    """Hidden layers and a last linear layer for every output at once.

    Maps ``(batch, time, width)`` (shared) or ``(batch, time, output, width)`` (gated) to
    ``(batch, time, value, output)``.
    """

    matrices = (("weights", (0, 2)),)

    def __init__(
        self,
        width: int,
        outputs: int,
        values: int,
        units: Sequence[GatedUnit],
        hidden: int,
        mix: Streaming | None = None,
        band: OutputBand | None = None,
    ) -> None:
        super().__init__()
        self.outputs, self.units = outputs, tuple(units)
        self.operations = frozenset({Operation.LINEAR, *(unit.operation for unit in units)})
        self.widths = [width] + [hidden] * len(self.units) + [values]
        wide = [hidden * unit.factor for unit in self.units] + [values]
        pairs = list(zip(self.widths[:-1], wide, strict=True))
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(outputs, into, out)) for into, out in pairs)
        self.biases = nn.ParameterList(nn.Parameter(torch.empty(outputs, out)) for out in wide)
        with torch.no_grad():
            for weight, bias in zip(self.weights, self.biases, strict=True):
                # PyTorch's bound for a linear layer with the inputs of a single output.
                # shrink it too far.
                bound = 1.0 / math.sqrt(weight.shape[1])
                weight.uniform_(-bound, bound)
                bias.uniform_(-bound, bound)
        self.mix, self.band = mix, band

    def initial_state(self, batch: int, like: Tensor) -> State:
        return () if self.mix is None else self.mix.initial_state(batch, like)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        if x.ndim == 3:
            # Without a gate all outputs read the same features: one wide product replaces one for each output.
            shared = self.weights[0].transpose(0, 1).flatten(1)
            y = (x @ shared).unflatten(-1, (self.outputs, -1)) + self.biases[0]
        else:
            y = self._layer(0, x)
        if not self.units:
            y = y.transpose(2, 3)
            return y if self.band is None else self.band(y), state
        y = self.units[0].apply(y)
        for layer, unit in enumerate(self.units[1:], start=1):
            y = unit.apply(self._layer(layer, y))
        if self.mix is not None:
            y, state = self.mix(y, state)
        return self._layer(len(self.units), y).transpose(2, 3), state

    def _layer(self, layer: int, x: Tensor) -> Tensor:
        """Return ``(batch, time, output, in)`` to ``(batch, time, output, out)``."""
        result: Tensor = torch.einsum("btci,cio->btco", x, self.weights[layer]) + self.biases[layer]
        return result

    def lower(self, build: Builder, x: str) -> str:
        weights = [weight.transpose(1, 2) for weight in self.weights]
        # A representation of the shared width has no gate before it, and the first layer is one dense layer.
        if build.width(x) == self.widths[0]:
            first, bias = weights[0].flatten(0, 1), self.biases[0].flatten()
            x = build.add(Dense, "layer1", x, weight=first, bias=bias)
        else:
            x = build.add(GroupedDense, "layer1", x, weight=weights[0], bias=self.biases[0])
        if self.units:
            x = self.units[0].lower(build, x, self.outputs)
            for number, unit in enumerate(self.units[1:], start=1):
                x = build.add(GroupedDense, f"layer{number + 1}", x, weight=weights[number], bias=self.biases[number])
                x = unit.lower(build, x, self.outputs)
            if self.mix is not None:
                x = self.mix.lower(build, x)
            last = f"layer{len(self.weights)}"
            x = build.add(GroupedDense, last, x, weight=weights[-1], bias=self.biases[-1])
        values = self.widths[-1]
        # Values vary slowest in the results, so that the first block of numbers is the prediction of all outputs.
        x = build.pick("by_value", x, [c * values + v for v in range(values) for c in range(self.outputs)])
        return x if self.band is None else self.band.lower(build, x)

    def costs(self) -> list[Cost]:
        own = Cost(
            f"heads, {self.outputs} x {'-'.join(map(str, self.widths))}",
            sum(weight.numel() for weight in [*self.weights, *self.biases]),
            per_prediction=sum(weight.numel() for weight in self.weights),
            width_in=self.widths[0],
            width_out=self.outputs * max(weight.shape[2] for weight in self.weights),
            per_time_step=False,
        )
        return [own] if self.mix is None else [own, *self.mix.costs()]
