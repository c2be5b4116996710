"""From logged channels in SI units to scaled features, as a stream: the first layer of every predictor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from edp.data.features import DERIVATIONS, Derived
from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, ScaleShift, Standardise
from edp.ir.memory import Difference, Starting, TrailingMean
from edp.networks.streaming import Cost, State, Streaming
from edp.networks.trailing import StreamingTrailingMean


@dataclass(frozen=True)
class _Span:
    """Derived channels that are means over one span of sources, or of their changes.

    Attributes:
        of_changes: see `Derivation`.
        ticks: length of the span in samples; 1 needs no mean.
        entries: their numbers among the derived channels.
    """

    of_changes: bool
    ticks: int
    entries: tuple[int, ...]


def _spans(derived: Sequence[Derived], rate_hz: float) -> tuple[_Span, ...]:
    """Group derived channels by the kind and length of their mean, starting with channels without a mean."""
    kinds = [(DERIVATIONS[entry.how].of_changes, entry.ticks(rate_hz)) for entry in derived]
    return tuple(
        _Span(*kind, tuple(number for number, other in enumerate(kinds) if other == kind))
        for kind in sorted(set(kinds), key=lambda kind: (kind[1], kind[0]))
    )


class FrontEnd(Streaming):
    """Derived channels and scaling (eq. 3.1, 3.4, 3.5), with the parameters stored as buffers.

    Maps inputs ``(batch, time, input)`` in SI units to physical features ``(batch, time, feature)``; `scale` gives
    the standardised features. The state has the previous inputs, a flag for their presence, and the sums for derived
    means. At the first sample after a reset every change is 0. Inputs of the physics base come after the inputs of
    features and are ignored here. From sample `init_samples` on, initialisation inputs are replaced by their means.
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
        self.init_channels = [inputs.index(name) for name in task.features.init_channels]
        self.init_samples = task.features.init_samples if self.init_channels else 1
        self.lasting = len(task.features.lasting)
        derived = task.features.derived
        self.derived = [inputs.index(entry.source) for entry in derived]
        self.spans = _spans(derived, task.rate_hz)
        self.means = nn.ModuleList(StreamingTrailingMean(len(s.entries), s.ticks) for s in self.spans if s.ticks > 1)
        self.gains = [entry.gain(task.rate_hz) for entry in derived]
        self.register_buffer("offset", torch.tensor(scaler.feature_offset, dtype=torch.get_default_dtype()))
        self.register_buffer("width", torch.tensor(scaler.feature_scale, dtype=torch.get_default_dtype()))

    def initial_state(self, batch: int, like: Tensor) -> State:
        rings = tuple(mean.initial_state(batch, like) for mean in self._means())
        return like.new_zeros(batch, 1, self.sources), like.new_zeros(batch, 1, 1), rings

    def _means(self) -> list[StreamingTrailingMean]:
        return [mean for mean in self.means if isinstance(mean, StreamingTrailingMean)]

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        previous, age, rings = state
        x = x[..., : self.sources]
        # At the first tick after a reset the previous sample is the tick itself: derivatives start at zero, not with
        # a jump.
        first = torch.where(age > 0.5, previous, x[:, :1])
        before = torch.cat([first, x[:, :-1]], dim=1)
        derived, rings = self._derive(x, x - before, rings)
        columns = [x[..., : self.logged], *derived]
        if self.init_channels:
            columns += self._start(x[..., self.init_channels], age)
        # Age is counted no further than needed, so that it stays exact in float32 over hours.
        age = (age + x.shape[1]).clamp(max=self.init_samples)
        return torch.cat(columns, dim=-1), (x[:, -1:], age, rings)

    def _derive(self, x: Tensor, change: Tensor, rings: tuple[State, ...]) -> tuple[list[Tensor], tuple[State, ...]]:
        """Return the derived channels, each ``(batch, time, 1)``, in order, and the next states of their means."""
        columns: dict[int, Tensor] = {}
        means, states, after = iter(self._means()), iter(rings), []
        for span in self.spans:
            source = change if span.of_changes else x
            values = source[..., [self.derived[entry] for entry in span.entries]]
            if span.ticks > 1:
                values, ring = next(means)(values, next(states))
                after.append(ring)
            for column, entry in enumerate(span.entries):
                columns[entry] = values[..., column : column + 1] * self.gains[entry]
        return [columns[entry] for entry in range(len(self.derived))], tuple(after)

    def _start(self, x: Tensor, age: Tensor) -> list[Tensor]:
        """Return the channels of the start ``(batch, time, channel)``, and whether they are read at a tick."""
        read = age + torch.arange(x.shape[1], device=x.device).view(1, -1, 1) < self.init_samples
        # Behind its ticks a channel of the start is replaced by its mean, which is zero after scaling.
        mean = self.offset[self.lasting : self.lasting + len(self.init_channels)]
        return [torch.where(read, x, mean), read.to(x)]

    def scale(self, features: Tensor) -> Tensor:
        """Return the standardised features."""
        return (features - self.offset) / self.width

    def lower(self, build: Builder, x: str) -> str:
        """Return the physical features."""
        parts = [build.pick("logged", x, range(self.logged))]
        if self.derived:
            parts.append(self._lower_derived(build, x))
        if self.init_channels:
            mean = self.offset[self.lasting : self.lasting + len(self.init_channels)]
            read = build.pick("start", x, self.init_channels)
            parts.append(build.add(Starting, "starting", read, mean=mean, ticks=self.init_samples))
        return build.join("features", *parts)

    def _lower_derived(self, build: Builder, x: str) -> str:
        """Add the derived channels in order: differences, means of differences and values, then gains."""
        results: list[str] = []
        order: list[int] = []
        for number, span in enumerate(self.spans):
            sources = build.pick(f"sources{number or ''}", x, [self.derived[entry] for entry in span.entries])
            gain = torch.tensor([self.gains[entry] for entry in span.entries])
            name = f"derived{number or ''}"
            if span.of_changes:
                # A mean is linear: gains before it save a layer.
                sources = build.add(Difference, name, sources, factor=gain, from_zero=False)
            if span.ticks > 1:
                size = len(span.entries)
                sources = build.add(TrailingMean, f"{name}.mean", sources, size=size, window=span.ticks)
            results.append(sources)
            order += span.entries
        together = build.join("derived_by_span", *results)
        return build.pick("derived_in_order", together, [order.index(entry) for entry in range(len(order))])

    def lower_scale(self, build: Builder, features: str) -> str:
        """Return the standardised features."""
        return build.add(Standardise, "scaled", features, offset=self.offset, scale=self.width)

    def costs(self) -> list[Cost]:
        return [Cost("features and scaling", 0, width_in=self.inputs, width_out=int(self.offset.numel()))]


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
        """Return the reference of standardised targets: present values in standard deviations; zero in absolute mode.

        Shape ``(batch, time, horizon, target)``; in absolute mode ``(batch, time, 1, 1)``.
        """
        base = self._base(features)
        # Zeros have the shape of a level, so that terms of the loss need no special case.
        return base / self.width if isinstance(base, Tensor) else features.new_zeros(*features.shape[:2], 1, 1)

    def encode(self, future: Tensor, features: Tensor) -> Tensor:
        """Return the standardised targets from future SI values ``(batch, time, horizon, target)``."""
        return (future - self._base(features) - self.offset) / self.width

    def decode(self, code: Tensor, features: Tensor) -> Tensor:
        """Return SI predictions from the network's output, same shape."""
        return code * self.width + self.offset + self._base(features)

    def lower_base(self, build: Builder, features: str) -> str | None:
        """Present target values, ``horizon * target``, in delta mode; None in absolute mode."""
        return build.pick("present", features, self.present * len(self.width)) if self.delta else None

    def lower_encode(self, build: Builder, future: str, base: str | None) -> str:
        """Return the standardised targets from future SI values."""
        if base is not None:
            future = build.combine("change", BinaryOperation.SUBTRACT, future, base)
        return build.add(Standardise, "encoded", future, offset=self.offset.flatten(), scale=self.width.flatten())

    def lower_decode(self, build: Builder, name: str, code: str, base: str | None) -> str:
        """Return SI values from one or several sets of standardised ones, ``set * horizon * target``."""
        one = self.width.numel()
        # Bounds carry several sets of the same numbers; gains repeat once for each set.
        sets = build.width(code) // one
        gain, shift = self.width.flatten().repeat(sets), self.offset.flatten().repeat(sets)
        value = build.add(ScaleShift, f"{name}.decoded", code, gain=gain, shift=shift)
        if base is None:
            return value
        bases = build.pick(f"{name}.present", base, list(range(one)) * sets)
        return build.combine(name, BinaryOperation.ADD, value, bases)
