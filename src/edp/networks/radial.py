"""Radial basis functions: closeness of the present input to typical situations of the training data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Clip, Dense, Function, ScaleShift
from edp.networks.streaming import Cost, Operation, State, Streaming
from edp.settings.bounds import shown

MAX_CENTRES = 4096


def check_near(near: Sequence[int], lags: Sequence[int], centres: int) -> None:
    """Refuse spans of radial basis functions on few columns that a committee cannot have.

    Raises:
        ConfigError: one that is neither 0 nor among `lags`, spans that do not rise, or no centres for them.
    """
    if list(near) != sorted(set(near)) or any(span != 0 and span not in lags for span in near):
        raise ConfigError(
            f"local_lags: {shown(near)}; spans that rise, each 0 for present values alone or among "
            f"lags = {shown(lags)}, must hold"
        )
    if near and not centres:
        raise ConfigError(
            f"local_lags: {shown(near)} with centres = 0, which makes no basis functions; give centres as well"
        )


class RadialFeatures(Streaming):
    """``sigmoid(-|z - c|^2 / 2)`` for each centre c, ``(batch, time, width)`` to ``(batch, time, centres)``; no memory.

    ``z`` is the input times `gain`. The argument is a linear layer on ``[z ; -|z|^2 / 2]`` with the weights
    ``[c ; 1]`` and the bias ``-|c|^2 / 2``. Away from a centre the sigmoid falls like the Gaussian kernel
    ``exp(-|z - c|^2 / 2)``, and unlike it every target computes it in integers, too. Far from all centres a linear map
    of the features is its intercept alone.

    Args:
        width: columns of its input.
        centres: number of centres.
        columns: indices of the columns that it reads, each limited to its range; None for all columns without limits.

    Attributes:
        columns: indices of the columns that it reads.
        gain: factor of each column: one divided by the product of length scale and standard deviation, ``(column,)``.
        weight: ``(centre, column + 1)``; at first all centres are at the origin.
        bias: ``(centre,)``.
        low: limits of the columns, ``(column,)``, where some are chosen; at first all numbers of single precision.
            Few columns allow long basis functions with large weights, which run away where no row was.
        high: upper limits, same shape.
    """

    gain: Tensor
    low: Tensor
    high: Tensor
    minus_half: Tensor
    operations = frozenset({Operation.LINEAR, Operation.SIGMOID})
    matrices = (("weight", (0,)),)

    def __init__(self, width: int, centres: int, columns: Sequence[int] | None = None) -> None:
        super().__init__()
        self.width, self.count = width, centres
        self.columns = tuple(range(width)) if columns is None else tuple(columns)
        self.clipped = columns is not None
        read = len(self.columns)
        self.register_buffer("gain", torch.ones(read))
        self.register_buffer("minus_half", torch.full((1, read), -0.5), persistent=False)
        if self.clipped:
            most = torch.full((read,), torch.finfo(torch.float32).max)
            self.register_buffer("low", -most)
            self.register_buffer("high", most)
        self.weight = nn.Parameter(torch.zeros(centres, read + 1))
        self.bias = nn.Parameter(torch.zeros(centres))
        self.set_centres(torch.zeros(centres, read))

    def set_centres(self, centres: Tensor) -> None:
        """Put the centres ``(centre, column)``, in lengths times spreads, where the basis functions are largest."""
        with torch.no_grad():
            self.weight.copy_(torch.cat([centres, torch.ones_like(centres[:, :1])], dim=1))
            self.bias.copy_(-0.5 * centres.square().sum(dim=1))

    def set_limits(self, low: Tensor, high: Tensor) -> None:
        """Hold each chosen column within the range that was recorded, ``(column,)`` each."""
        with torch.no_grad():
            self.low.copy_(low)
            self.high.copy_(high)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return ()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        if self.clipped:
            x = torch.clamp(x[..., self.columns], self.low, self.high)
        z = x * self.gain
        norm = nn.functional.linear(z * z, self.minus_half)
        return torch.sigmoid(nn.functional.linear(torch.cat([z, norm], dim=-1), self.weight, self.bias)), state

    def lower(self, build: Builder, x: str) -> str:
        x = build.pick("read", x, self.columns)
        # Limits that are not set have no effect.
        if self.clipped and bool((self.high < torch.finfo(torch.float32).max).any()):
            x = build.add(Clip, "within", x, low=self.low, high=self.high)
        z = build.add(ScaleShift, "situation", x, gain=self.gain, shift=torch.zeros_like(self.gain))
        square = build.combine("square", BinaryOperation.MULTIPLY, z, z)
        norm = build.add(Dense, "norm", square, weight=self.minus_half, bias=torch.zeros(1))
        both = build.join("situation_and_norm", z, norm)
        argument = build.add(Dense, "argument", both, weight=self.weight, bias=self.bias)
        return build.add(Activate, "nearness", argument, function=Function.SIGMOID, size=self.count)

    def costs(self) -> list[Cost]:
        return [
            Cost(
                f"{self.count} radial basis functions of {len(self.columns)} columns",
                self.weight.numel() + self.bias.numel(),
                per_prediction=len(self.columns) + self.weight.numel(),
                width_in=self.width,
                width_out=self.count,
                per_time_step=False,
            )
        ]
