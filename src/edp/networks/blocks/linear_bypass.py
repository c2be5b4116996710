"""Linear skip connection: a finite impulse response from the scaled features straight to the output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.errors import ConfigError, closest
from edp.ir import Builder
from edp.ir.memory import Convolution
from edp.networks.blocks.base import BLOCKS, BlockSlot, OutputSpace
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of
from edp.settings.bounds import MAX_KERNEL, check_bounds, integer

STARTS = ("ridge", "cross_validated", "zero")


@BLOCKS.register("linear_bypass")
@dataclass(frozen=True, kw_only=True)
class LinearBypass:
    """Add ``sum_i A_i x[t - i] + b`` to the standardised output, outside the output activation.

    Attributes:
        taps: samples of history, the present one included.
        init: ``ridge`` starts from the ridge regression on the training data, with penalty and history chosen on
            the validation data; ``cross_validated`` from the one on both, chosen by cross-validation (for little data);
            ``zero`` from nothing.
        trainable: False keeps the start values, so that the network learns what the linear map leaves.

    Raises:
        ConfigError: taps below 1, unknown start, or a skip connection that is zero and not trained.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.BYPASS
    space: ClassVar[dict[str, object]] = {"taps": (5, 50), "init": STARTS}
    taps: int = 25
    init: str = "ridge"
    trainable: bool = True

    def __post_init__(self) -> None:
        check_bounds("linear_bypass", self, taps=integer(1, MAX_KERNEL))
        if self.init not in STARTS:
            raise ConfigError(f"linear_bypass: unknown init '{self.init}'{closest(self.init, STARTS)}")
        # A map that starts at zero and never changes adds nothing; the combination is refused, not ignored.
        if self.init == "zero" and not self.trainable:
            raise ConfigError("linear_bypass: init = 'zero' with trainable = false does nothing; change one of them")

    def build(self, space: OutputSpace) -> Streaming:
        """Build the skip connection with zero weights; training sets the ridge solution."""
        return Bypass(space.features, space.horizons, space.outputs, self)


class Bypass(Streaming):
    """Causal linear filter; ``weight`` has shape ``(horizon * output, feature, tap)``, the last tap is the present."""

    operations = frozenset({Operation.CONV1D})
    matrices = (("weight", (0,)),)

    def __init__(self, features: int, horizons: int, outputs: int, spec: LinearBypass) -> None:
        super().__init__()
        self.spec, self.features, self.horizons, self.outputs = spec, features, horizons, outputs
        # Zero until training sets the regression: a bundle loads its weights over them, and a fresh network is
        # unchanged.
        self.weight = nn.Parameter(torch.zeros(horizons * outputs, features, spec.taps), requires_grad=spec.trainable)
        self.bias = nn.Parameter(torch.zeros(horizons * outputs), requires_grad=spec.trainable)
        self.fixed = () if spec.trainable else ("weight", "bias")

    def initial_state(self, batch: int, like: Tensor) -> State:
        # Zeros stand for the mean of scaled features, so that a reset starts from the usual operating point.
        return like.new_zeros(batch, self.spec.taps - 1, self.features)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        history = torch.cat([state, x], dim=1)
        y = functional.conv1d(history.transpose(1, 2), self.weight, self.bias).transpose(1, 2)
        return y.unflatten(-1, (self.horizons, self.outputs)), history[:, x.shape[1] :]

    def lower(self, build: Builder, x: str) -> str:
        # Streaming layers take the tap before the feature, PyTorch the feature before the tap.
        return build.add(Convolution, "bypass", x, weight=self.weight.transpose(1, 2), bias=self.bias)

    def costs(self) -> list[Cost]:
        wide = self.horizons * self.outputs
        return [
            Cost(
                "linear skip connection",
                parameters_of(self),
                per_prediction=self.weight.numel(),
                width_in=self.features,
                width_out=wide,
                per_time_step=False,
            )
        ]
