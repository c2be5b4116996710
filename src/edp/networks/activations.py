"""Output activations g in standardised space (thesis 3.2.2.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import Activate, Function, ScaleShift
from edp.networks.streaming import Operation
from edp.registry import Registry
from edp.settings.bounds import above, check_bounds


class ActivationSpec(Protocol):
    """Options of an output activation."""

    def build(self, outputs: int) -> nn.Module:
        """Build a module on ``(..., output)``.

        ``lower(build, x)`` adds it to a graph, on ``horizon * output`` elements.
        """
        ...

    def bound(self) -> float | None:
        """Return the largest possible magnitude; None if unlimited."""
        ...


ACTIVATIONS: Registry[type] = Registry("activation")
AMPLITUDE = above(0.0, 1000.0)
"""Accepted range of learned amplitudes, in standard deviations of the target. With an amplitude above a few tens, tanh
is linear over all values that occur."""


@ACTIVATIONS.register("identity")
@dataclass(frozen=True, kw_only=True)
class Identity:
    """``g(x) = x``."""

    def build(self, outputs: int) -> nn.Module:
        """Build the identity module."""
        return _Identity()

    def bound(self) -> float | None:
        """Return None: the activation is unbounded."""
        return None


class _Identity(nn.Identity):
    def lower(self, build: Builder, x: str) -> str:
        return x


@ACTIVATIONS.register("tanh")
@dataclass(frozen=True, kw_only=True)
class Tanh:
    """``g(x) = tanh(x)``: targets beyond one standard deviation cannot be reached."""

    def build(self, outputs: int) -> nn.Module:
        """Build the hyperbolic tangent."""
        return _Tanh()

    def bound(self) -> float | None:
        """Return one standard deviation of the target."""
        return 1.0


class _Tanh(nn.Tanh):
    operations = frozenset({Operation.TANH})

    def lower(self, build: Builder, x: str) -> str:
        return build.add(Activate, "tanh", x, function=Function.TANH, size=build.width(x))


@ACTIVATIONS.register("stanh")
@dataclass(frozen=True, kw_only=True)
class ScaledTanh:
    """``g_i(x) = a_i tanh(x)`` with a learned amplitude per output (eq. 3.28).

    The amplitude is a smooth function of a free number, so it stays inside its limits without clamping, which
    would stop its gradient there.

    Attributes:
        start: amplitude at the start of training, in standard deviations of the target.
        low: smallest amplitude.
        high: largest amplitude.

    Raises:
        ConfigError: unless ``0 < low < start < high``.
    """

    # With 1 the targets would be cut at one standard deviation; 2.5 leaves nearly all of them in reach.
    start: float = 2.5
    low: float = 1.01
    high: float = 5.0

    def __post_init__(self) -> None:
        check_bounds("stanh", self, start=AMPLITUDE, low=AMPLITUDE, high=AMPLITUDE)
        # An amplitude at a bound would need an infinite logit; the start must lie strictly inside.
        if not 0 < self.low < self.start < self.high:
            raise ConfigError(
                f"stanh: low = {self.low}, start = {self.start}, high = {self.high}; 0 < low < start < high must hold"
            )

    def build(self, outputs: int) -> nn.Module:
        """Build the activation for `outputs` targets."""
        return _ScaledTanh(outputs, self)

    def bound(self) -> float | None:
        """Return the largest trainable amplitude."""
        return self.high


class _ScaledTanh(nn.Module):
    operations = frozenset({Operation.SIGMOID, Operation.TANH})

    def __init__(self, outputs: int, spec: ScaledTanh) -> None:
        super().__init__()
        self.spec = spec
        share = (spec.start - spec.low) / (spec.high - spec.low)
        self.free = nn.Parameter(torch.full((outputs,), share).logit())

    def amplitude(self) -> Tensor:
        """Return the learned amplitudes, ``(output,)``."""
        return self.spec.low + (self.spec.high - self.spec.low) * torch.sigmoid(self.free)

    def forward(self, x: Tensor) -> Tensor:
        return self.amplitude() * torch.tanh(x)

    def lower(self, build: Builder, x: str) -> str:
        size, amplitude = build.width(x), self.amplitude()
        y = build.add(Activate, "tanh", x, function=Function.TANH, size=size)
        # Outputs vary fastest within a horizon, so the amplitudes repeat once for each horizon.
        gain = amplitude.repeat(size // len(amplitude))
        return build.add(ScaleShift, "amplitude", y, gain=gain, shift=torch.zeros_like(gain))
