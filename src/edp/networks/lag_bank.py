"""Lag bank: changes over several time spans, the inputs of an autoregressive model, as a stream."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from edp.data.features import MAX_LAG
from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import Clip, ScaleShift
from edp.ir.memory import Difference
from edp.networks.streaming import Cost, State, Streaming
from edp.networks.trailing import StreamingTrailingMean
from edp.settings.bounds import shown


def check_lags(lags: Sequence[int]) -> None:
    """Refuse spans that `LagBank` cannot make.

    Raises:
        ConfigError: no span, one below 1 or above `MAX_LAG`, or spans that do not rise.
    """
    if not lags or list(lags) != sorted(set(lags)) or lags[0] < 1 or lags[-1] > MAX_LAG:
        raise ConfigError(
            f"lags: {shown(lags)}; at least one span in ticks, each from 1 to {MAX_LAG} and longer than the one "
            "before it, must hold"
        )


def check_smoothed(lags: Sequence[int], smoothed: Sequence[int]) -> None:
    """Refuse spans of smoothed changes that `LagBank` cannot make.

    Raises:
        ConfigError: one that is no span of `lags`, one of 1, or spans that do not rise.
    """
    if list(smoothed) != sorted(set(smoothed)) or any(span < 2 or span not in lags for span in smoothed):
        raise ConfigError(
            f"smoothed: {shown(smoothed)}; spans that rise, each of 2 ticks or more and among lags = {shown(lags)}, "
            "must hold"
        )


class LagBank(Streaming):
    """``[x[t] ; gain_l (x[t] - x[t - l]) for each lag l ; gain_m (x_m[t] - x_m[t - m]) for each smoothed span m]``.

    ``(batch, time, width)`` to ``width (1 + lags + smoothed)`` columns; ``x_m`` is the mean of x over the last m ticks.
    The change of such means (the Haar wavelet) has one m-th of the variance that noise gives to the change itself.

    The change over l ticks is l times the mean of the last l changes from tick to tick. In the first l samples of a
    stream it is l times the mean of the available changes, the first of which is 0. This extrapolates the stream
    backwards. The change of means over m is the mean of the last m changes over m. The state contains the previous
    input, a flag for it, and the changes that each mean needs.

    Args:
        width: number of inputs.
        lags: spans in ticks, rising.
        smoothed: those spans in `lags` for which the change of a mean is also computed.
        bounded: whether columns are limited to `low` and `high`.

    Attributes:
        gain: factor of each change, ``(lag + smoothed, width)``; training sets it to the inverse standard deviation.
        low: smallest value of each column, ``(columns,)``, of a bounded bank; no limit until it is set.
        high: largest value of each column, ``(columns,)``, of a bounded bank.
    """

    gain: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, width: int, lags: Sequence[int], smoothed: Sequence[int] = (), bounded: bool = False) -> None:
        super().__init__()
        check_lags(lags)
        check_smoothed(lags, smoothed)
        self.width, self.lags, self.smoothed, self.bounded = width, tuple(lags), tuple(smoothed), bounded
        # A mean of one is the change itself, and would carry a ring without rows.
        self.means = nn.ModuleList(StreamingTrailingMean(width, lag) for lag in self.lags if lag > 1)
        self.means_of_means = nn.ModuleList(StreamingTrailingMean(width, span) for span in self.smoothed)
        self.register_buffer("gain", torch.ones(len(self.spans), width))
        if bounded:
            most = torch.full((self.columns,), torch.finfo(torch.float32).max)
            self.register_buffer("low", -most)
            self.register_buffer("high", most)

    @property
    def spans(self) -> tuple[int, ...]:
        """Span of each change in samples, in the order of the columns after the present values."""
        return (*self.lags, *self.smoothed)

    @property
    def columns(self) -> int:
        """Number of columns per sample."""
        return self.width * (1 + len(self.spans))

    @property
    def reach(self) -> int:
        """Age in samples of the oldest value that a column reads."""
        return max(self.lags[-1], *(2 * span - 1 for span in self.smoothed), 1)

    def columns_over(self, span: int) -> list[int]:
        """Return the columns of the present values and of their changes over a lag.

        Only present values for span 0.
        """
        present = range(self.width)
        first = 0 if span == 0 else self.width * (1 + self.lags.index(span))
        return [*present, *(range(first, first + self.width) if span else ())]

    def set_limits(self, low: Tensor, high: Tensor) -> None:
        """Hold each column of a bounded bank within limits, ``(columns,)`` each."""
        with torch.no_grad():
            self.low.copy_(low)
            self.high.copy_(high)

    def _means(self) -> list[StreamingTrailingMean]:
        """Return the means of changes, then means of some of these."""
        return [mean for mean in (*self.means, *self.means_of_means) if isinstance(mean, StreamingTrailingMean)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        rings = tuple(mean.initial_state(batch, like) for mean in self._means())
        return like.new_zeros(batch, 1, self.width), like.new_zeros(batch, 1, 1), rings

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        previous, age, rings = state
        first = torch.where(age > 0.5, previous, x[:, :1])
        change = x - torch.cat([first, x[:, :-1]], dim=1)
        values, new = ([change] if self.lags[0] == 1 else []), []
        for mean, ring in zip(self._means(), rings, strict=True):
            source = change if len(values) < len(self.lags) else values[self._smooths(len(values))]
            value, after = mean(source, ring)
            values.append(value)
            new.append(after)
        parts = [x, *(value * (span * gain) for span, gain, value in zip(self.spans, self.gain, values, strict=True))]
        columns = torch.cat(parts, dim=-1)
        if self.bounded:
            columns = torch.clamp(columns, self.low.to(columns), self.high.to(columns))
        return columns, (x[:, -1:], torch.ones_like(age), tuple(new))

    def _smooths(self, span: int) -> int:
        """Return the index of the change whose mean is the change with index `span`."""
        return self.lags.index(self.spans[span])

    def lower(self, build: Builder, x: str) -> str:
        one = torch.ones(self.width)
        change = build.add(Difference, "change", x, factor=one, from_zero=False)
        values = [change] if self.lags[0] == 1 else []
        for mean in self._means():
            source = change if len(values) < len(self.lags) else values[self._smooths(len(values))]
            values.append(mean.lower(build, source))
        joined = build.join("changes", x, *values)
        spans = torch.tensor(self.spans, dtype=self.gain.dtype, device=self.gain.device)
        gain = torch.cat([one.to(self.gain), (spans[:, None] * self.gain).flatten()])
        columns = build.add(ScaleShift, "scaled_changes", joined, gain=gain, shift=torch.zeros_like(gain))
        # Limits that are not set have no effect.
        if not self.bounded or bool((self.high == torch.finfo(torch.float32).max).all()):
            return columns
        return build.add(Clip, "within", columns, low=self.low, high=self.high)

    def costs(self) -> list[Cost]:
        """Return the differences and sums only: no multiply-accumulates."""
        return [Cost(f"changes over {len(self.spans)} spans", 0, width_in=self.width, width_out=self.columns)]
