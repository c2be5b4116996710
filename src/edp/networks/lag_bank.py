"""Changes over several time spans: what an autoregressive model reads, as a stream."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from edp.data.features import MOST_LAG
from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import ScaleShift
from edp.ir.memory import Difference
from edp.networks.streaming import Cost, State, Streaming
from edp.networks.trailing import StreamingTrailingMean
from edp.settings.bounds import shown


def check_lags(lags: Sequence[int]) -> None:
    """Refuse spans that `LagBank` cannot make.

    Raises:
        ConfigError: no span, one below 1 or above `MOST_LAG`, or spans that do not rise.
    """
    if not lags or list(lags) != sorted(set(lags)) or lags[0] < 1 or lags[-1] > MOST_LAG:
        raise ConfigError(
            f"lags: {shown(lags)}; at least one span in ticks, each from 1 to {MOST_LAG} and longer than the one "
            "before it, must hold"
        )


class LagBank(Streaming):
    """``[x[t] ; gain_l (x[t] - x[t - l]) for each lag l]``: ``(batch, time, width)`` to ``width (1 + lags)`` columns.

    The change over l ticks is l times the mean of the last l changes from tick to tick. In the first l ticks of a
    stream it is l times the mean of those seen, the first of which is 0: the change that would be if the stream had
    gone on like this before. State: the input before, whether there was one, and the changes that each mean needs.

    Attributes:
        gain: what each change is multiplied by, ``(lag, width)``; a trainer sets one over its standard deviation.
    """

    gain: Tensor

    def __init__(self, width: int, lags: Sequence[int]) -> None:
        super().__init__()
        check_lags(lags)
        self.width, self.lags = width, tuple(lags)
        # A mean of one is the change itself, and would carry a ring without rows.
        self.means = nn.ModuleList(StreamingTrailingMean(width, lag) for lag in self.lags if lag > 1)
        self.register_buffer("gain", torch.ones(len(self.lags), width))

    @property
    def columns(self) -> int:
        """Numbers that it gives at a tick."""
        return self.width * (1 + len(self.lags))

    def _means(self) -> list[StreamingTrailingMean]:
        return [mean for mean in self.means if isinstance(mean, StreamingTrailingMean)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        rings = tuple(mean.initial_state(batch, like) for mean in self._means())
        return like.new_zeros(batch, 1, self.width), like.new_zeros(batch, 1, 1), rings

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        previous, age, rings = state
        first = torch.where(age > 0.5, previous, x[:, :1])
        change = x - torch.cat([first, x[:, :-1]], dim=1)
        results = [mean(change, ring) for mean, ring in zip(self._means(), rings, strict=True)]
        values, new = [value for value, _ in results], [after for _, after in results]
        if self.lags[0] == 1:
            values.insert(0, change)
        parts = [x, *(value * (lag * gain) for lag, gain, value in zip(self.lags, self.gain, values, strict=True))]
        return torch.cat(parts, dim=-1), (x[:, -1:], torch.ones_like(age), tuple(new))

    def lower(self, build: Builder, x: str) -> str:
        one = torch.ones(self.width)
        change = build.add(Difference, "change", x, factor=one, from_zero=False)
        means = [mean.lower(build, change) for mean in self._means()]
        joined = build.join("changes", x, *([change] if self.lags[0] == 1 else []), *means)
        spans = torch.tensor(self.lags, dtype=self.gain.dtype, device=self.gain.device)
        gain = torch.cat([one.to(self.gain), (spans[:, None] * self.gain).flatten()])
        return build.add(ScaleShift, "scaled_changes", joined, gain=gain, shift=torch.zeros_like(gain))

    def costs(self) -> list[Cost]:
        """Differences and sums only: no multiply-accumulates."""
        return [Cost(f"changes over {len(self.lags)} spans", 0, width_in=self.width, width_out=self.columns)]
