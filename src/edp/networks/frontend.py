"""From logged channels in SI units to scaled features, as a stream: the first layer of every predictor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edp.data.features import DERIVATIONS, derivative, difference
from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.errors import ExportError
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, ScaleShift, Standardise
from edp.ir.memory import Difference, Starting
from edp.networks.streaming import Cost, State, Streaming


class FrontEnd(Streaming):
    """Derived channels and scaling (eq. 3.1, 3.4, 3.5), with its numbers kept as buffers.

    Maps inputs ``(batch, time, input)`` in SI units to physical features ``(batch, time, feature)``; `scale` gives
    the standardised ones. State: the previous tick's inputs and whether there was one; at the first tick after a
    reset every derived value is 0. Inputs of the physics base follow those of the features and are passed over.
    Channels of the start have their mean from `starting_ticks` on, whatever is fed; the state then counts the ticks.
    """

    offset: Tensor
    width: Tensor

    def __init__(self, task: Task, scaler: Scaler) -> None:
        super().__init__()
        inputs = task.features.inputs
        self.logged = len(task.features.channels)
        self.inputs = len(task.inputs)
        self.sources = len(inputs)
        self.rate_hz = task.rate_hz
        self.starting = [inputs.index(name) for name in task.features.starting]
        self.starting_ticks = task.features.starting_ticks if self.starting else 1
        self.lasting = len(task.features.lasting)
        self.derived = [(DERIVATIONS[entry.how], inputs.index(entry.source)) for entry in task.features.derived]
        self.register_buffer("offset", torch.tensor(scaler.feature_offset, dtype=torch.get_default_dtype()))
        self.register_buffer("width", torch.tensor(scaler.feature_scale, dtype=torch.get_default_dtype()))

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, 1, self.sources), like.new_zeros(batch, 1, 1)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        previous, age = state
        x = x[..., : self.sources]
        # At the first tick after a reset the previous sample is the tick itself: derivatives start at zero, not with
        # a jump.
        first = torch.where(age > 0.5, previous, x[:, :1])
        before = torch.cat([first, x[:, :-1]], dim=1)
        columns = [x[..., : self.logged]]
        for how, source in self.derived:
            columns.append(how(x[..., source], before[..., source], self.rate_hz).unsqueeze(-1))
        if self.starting:
            columns += self._start(x[..., self.starting], age)
        # Age is counted no further than needed, so that it stays exact in float32 over hours.
        return torch.cat(columns, dim=-1), (x[:, -1:], (age + x.shape[1]).clamp(max=self.starting_ticks))

    def _start(self, x: Tensor, age: Tensor) -> list[Tensor]:
        """Channels of the start ``(batch, time, channel)``, and whether they are read at a tick."""
        read = age + torch.arange(x.shape[1], device=x.device).view(1, -1, 1) < self.starting_ticks
        # Behind its ticks a channel of the start is replaced by its mean, which is zero after scaling.
        mean = self.offset[self.lasting : self.lasting + len(self.starting)]
        return [torch.where(read, x, mean), read.to(x)]

    def scale(self, features: Tensor) -> Tensor:
        """Standardised features."""
        return (features - self.offset) / self.width

    def lower(self, build: Builder, x: str) -> str:
        """Physical features."""
        parts = [build.pick("logged", x, range(self.logged))]
        if self.derived:
            factors = [_factor(how, self.rate_hz) for how, _ in self.derived]
            sources = build.pick("sources", x, [source for _, source in self.derived])
            parts.append(build.add(Difference, "derived", sources, factor=torch.tensor(factors), from_zero=False))
        if self.starting:
            mean = self.offset[self.lasting : self.lasting + len(self.starting)]
            read = build.pick("start", x, self.starting)
            parts.append(build.add(Starting, "starting", read, mean=mean, ticks=self.starting_ticks))
        return build.join("features", *parts)

    def lower_scale(self, build: Builder, features: str) -> str:
        """Standardised features."""
        return build.add(Standardise, "scaled", features, offset=self.offset, scale=self.width)

    def costs(self) -> list[Cost]:
        return [Cost("features and scaling", 0, width_in=self.inputs, width_out=int(self.offset.numel()))]


def _factor(how: object, rate_hz: float) -> float:
    """What a derivation multiplies a difference with."""
    if how is difference:
        return 1.0
    if how is derivative:
        return rate_hz
    name = DERIVATIONS.name_of(how)
    raise ExportError(
        f"derivation '{name}' has no form as a layer; 'difference' and 'derivative' have: use one of them"
    )


class TargetTransform(nn.Module):
    """Between SI targets and the network's standardised ones (thesis 3.2.1)."""

    offset: Tensor
    width: Tensor

    def __init__(self, task: Task, scaler: Scaler) -> None:
        super().__init__()
        self.delta = task.mode == "delta"
        self.present = [index for index in task.present if index is not None]
        self.register_buffer("offset", torch.tensor(scaler.target_offset, dtype=torch.get_default_dtype()))
        self.register_buffer("width", torch.tensor(scaler.target_scale, dtype=torch.get_default_dtype()))

    def _base(self, features: Tensor) -> Tensor | float:
        """Present target values ``(batch, time, 1, target)`` in delta mode, else 0."""
        return features[..., self.present].unsqueeze(-2) if self.delta else 0.0

    def level(self, features: Tensor) -> Tensor:
        """What standardised targets are counted from: present values in standard deviations; zero in absolute mode.

        Shape ``(batch, time, horizon, target)``; in absolute mode ``(batch, time, 1, 1)``.
        """
        base = self._base(features)
        # Zeros have the shape of a level, so that terms of the loss need no special case.
        return base / self.width if isinstance(base, Tensor) else features.new_zeros(*features.shape[:2], 1, 1)

    def encode(self, future: Tensor, features: Tensor) -> Tensor:
        """Standardised targets from future SI values ``(batch, time, horizon, target)``."""
        return (future - self._base(features) - self.offset) / self.width

    def decode(self, code: Tensor, features: Tensor) -> Tensor:
        """SI predictions from the network's output, same shape."""
        return code * self.width + self.offset + self._base(features)

    def lower_base(self, build: Builder, features: str) -> str | None:
        """Present target values, ``horizon * target``, in delta mode; None in absolute mode."""
        return build.pick("present", features, self.present * len(self.width)) if self.delta else None

    def lower_encode(self, build: Builder, future: str, base: str | None) -> str:
        """Standardised targets from future SI values."""
        if base is not None:
            future = build.combine("change", BinaryOperation.SUBTRACT, future, base)
        return build.add(Standardise, "encoded", future, offset=self.offset.flatten(), scale=self.width.flatten())

    def lower_decode(self, build: Builder, name: str, code: str, base: str | None) -> str:
        """SI values from one or several sets of standardised ones, ``set * horizon * target``."""
        one = self.width.numel()
        # Bounds carry several sets of the same numbers; gains repeat once for each set.
        sets = build.width(code) // one
        gain, shift = self.width.flatten().repeat(sets), self.offset.flatten().repeat(sets)
        value = build.add(ScaleShift, f"{name}.decoded", code, gain=gain, shift=shift)
        if base is None:
            return value
        bases = build.pick(f"{name}.present", base, list(range(one)) * sets)
        return build.combine(name, BinaryOperation.ADD, value, bases)
