"""Means over the last ticks of a stream, stable over hours."""

from __future__ import annotations

import torch
import torch.nn.functional as functional
from torch import Tensor

from edp.streaming import Cost, Operation, State, Streaming


class TrailingMean(Streaming):
    """Mean of the last `window` ticks, ``(batch, time, width)`` to the same shape.

    Before `window` ticks have passed, the mean of those seen; at the last tick of a window from reset that is the mean
    over the whole window. State: ring of the last ``window - 1`` inputs and how many ticks were seen, up to `window`.
    Only additions over at most `window` terms are made, so no error grows with the length of the stream.
    """

    operations = frozenset({Operation.TRAILING_MEAN})

    def __init__(self, width: int, window: int) -> None:
        super().__init__()
        self.width, self.window = width, window

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.window - 1, self.width), like.new_zeros(batch, 1, 1)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        ring, seen = state
        history, ticks = torch.cat([ring, x], dim=1), x.shape[1]
        passed = torch.arange(1, ticks + 1, device=x.device, dtype=x.dtype)[:, None]
        count = (seen + passed).clamp(max=self.window)
        return _sums(history, self.window) / count, (history[:, ticks:], count[:, -1:])

    def costs(self) -> list[Cost]:
        """Additions only: no multiply-accumulates."""
        return [Cost(f"mean over {self.window}", 0, width_in=self.width, width_out=self.width)]


def _sums(history: Tensor, window: int) -> Tensor:
    """Sums over every `window` neighbouring rows of ``(batch, time, width)``.

    Rows are cut into blocks of `window`. A run of `window` rows is the end of one block and the beginning of the next,
    so it is a running sum from the right plus one from the left: linear in time, and nothing is ever subtracted.
    """
    rows = history.shape[1]
    ticks = rows - window + 1
    blocks = functional.pad(history, (0, 0, 0, -rows % window)).unflatten(1, (-1, window))
    left = blocks.cumsum(dim=2).flatten(1, 2)[:, window - 1 : rows]
    right = blocks.flip(2).cumsum(dim=2).flip(2).flatten(1, 2)[:, :ticks]
    whole = torch.arange(ticks, device=history.device) % window == 0
    return left + right.masked_fill(whole[:, None], 0.0)
