"""Means over the last ticks of a stream, stable over hours."""

from __future__ import annotations

import torch
from torch import Tensor

from edp.ir import Builder
from edp.ir.memory import TrailingMean as TrailingMeanLayer
from edp.networks.streaming import Cost, State, Streaming


class StreamingTrailingMean(Streaming):
    """Mean of the last `window` ticks, ``(batch, time, width)`` to the same shape.

    Before `window` ticks have passed, the mean of those seen; at the last tick of a window from reset that is the mean
    over the whole window. State: ring of the last ``window - 1`` inputs and how many ticks were seen, up to `window`.
    Only sums of at most `window` terms are made, so no error grows with the length of the stream.
    """

    def __init__(self, width: int, window: int) -> None:
        super().__init__()
        self.width, self.window = width, window

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.window - 1, self.width), like.new_zeros(batch, 1, 1)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        ring, seen = state
        history, ticks = torch.cat([ring, x], dim=1), x.shape[1]
        # Ticks since the reset count, not those in the chunk, so that chunks of any length agree.
        passed = torch.arange(1, ticks + 1, device=x.device, dtype=x.dtype)[:, None]
        count = (seen + passed).clamp(max=self.window)
        # Sums are formed anew instead of carried: a running sum drifts over hours of float32 additions.
        return _sums(history, self.window) / count, (history[:, ticks:], count[:, -1:])

    def lower(self, build: Builder, x: str) -> str:
        return build.add(TrailingMeanLayer, "mean", x, size=self.width, window=self.window)

    def costs(self) -> list[Cost]:
        """Return additions only: no multiply-accumulates."""
        return [Cost(f"mean over {self.window}", 0, width_in=self.width, width_out=self.width)]


def _sums(history: Tensor, window: int) -> Tensor:
    """Return the sums over every `window` neighbouring rows of ``(batch, time, width)``.

    Sums of 1, 2, 4, ... rows are computed by doubling, and the sums that compose `window` are added. Every sum uses the
    same additions for any division of a stream into chunks, without subtractions.
    """
    ticks = history.shape[1] - window + 1
    runs, size, start = history, 1, 0
    total = torch.zeros_like(history[:, :ticks])
    # Binary decomposition of the window: log2(window) additions a tick, of equal rounding at every chunk length.
    while size <= window:
        if window & size:
            total = total + runs[:, start : start + ticks]
            start += size
        runs, size = runs[:, :-size] + runs[:, size:], 2 * size
    return total
