"""Attention pooling of hidden states as a stream."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.memory import UNSEEN, AttentionPool
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of

# Query rows per block of the banded softmax: memory stays linear in the sequence length.
BLOCK = 128


class AttentionPooling(Streaming):
    """Softmax-weighted mean of the hidden states of the last `window` ticks (eq. 3.33, 3.34), with h itself.

    Maps ``(batch, time, units)`` to ``[pooled ; h]``, ``(batch, time, 2 units)`` (eq. 3.35). In a stream the mean
    runs over the trailing window; before `window` ticks have passed, over those seen. At the last tick of a window
    from reset this is the thesis's sum over the whole window. State: ring of states and of scores.
    """

    operations = frozenset({Operation.LINEAR, Operation.MATMUL, Operation.SOFTMAX})
    # A softmax does not notice a shift of all scores; the thesis counts this bias, so it is kept.
    indifferent = ("score.bias",)

    def __init__(self, units: int, window: int) -> None:
        super().__init__()
        self.units, self.window = units, window
        self.score = nn.Linear(units, 1)

    def initial_state(self, batch: int, like: Tensor) -> State:
        past = self.window - 1
        return like.new_zeros(batch, past, self.units), like.new_full((batch, past), UNSEEN)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        states = torch.cat([state[0], x], dim=1)
        scores = torch.cat([state[1], self.score(x).squeeze(-1)], dim=1)
        ticks = x.shape[1]
        blocks = [self._pool(states, scores, at, min(at + BLOCK, ticks)) for at in range(0, ticks, BLOCK)]
        pooled = blocks[0] if len(blocks) == 1 else torch.cat(blocks, dim=1)
        return torch.cat([pooled, x], dim=-1), (states[:, ticks:], scores[:, ticks:])

    def _pool(self, states: Tensor, scores: Tensor, start: int, stop: int) -> Tensor:
        """Return the pooled states for ticks start..stop: a softmax over a band of `window` columns."""
        keys = slice(start, stop + self.window - 1)
        ticks, columns = stop - start, stop - start + self.window - 1
        lag = torch.arange(columns, device=scores.device) - torch.arange(ticks, device=scores.device)[:, None]
        band = (lag >= 0) & (lag < self.window)
        # Twice the offset of unseen ticks: a column outside the band loses even against ticks before the reset.
        weights = scores[:, None, keys].masked_fill(~band, 2 * UNSEEN).softmax(dim=-1)
        return weights @ states[:, keys]

    def lower(self, build: Builder, x: str) -> str:
        score, bias = self.score.weight[0], self.score.bias
        pooled = build.add(AttentionPool, "pooling", x, score=score, bias=bias, window=self.window)
        return build.join("pooled_and_last", pooled, x)

    def costs(self) -> list[Cost]:
        return [
            Cost(
                f"attention pooling over {self.window}",
                parameters_of(self),
                # Scores cost one multiply-accumulate a unit, the weighted sum `window` of them.
                pooling=(self.window + 1) * self.units,
                width_in=self.units,
                width_out=2 * self.units,
            )
        ]
