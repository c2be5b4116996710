"""Attention bridge: a transformer layer between the convolutions and the LSTM (eq. 3.10, 3.11)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import Activate, BinaryOperation, Dense, Function, LayerNorm
from edp.ir.memory import UNSEEN, WindowAttention
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of
from edp.settings.bounds import MOST_CHANNELS, check_bounds, integer

# Query rows per block of the banded softmax: memory stays linear in the sequence length, and little of a block is idle.
BLOCK = 64


@BLOCKS.register("attention_bridge")
@dataclass(frozen=True, kw_only=True)
class AttentionBridge:
    """Self-attention and a feed-forward network on the channels, each after a layer norm and with a residual path.

    ``R' = R + MHA(LN(R))`` (eq. 3.10) and ``R'' = R' + FFN(LN(R'))`` (eq. 3.11); the FFN has ``2 C`` hidden units and
    GELU. Each tick attends to itself and the ``window - 1`` ticks before it, never to later ones. The thesis lets every
    tick of a window attend to the whole window, later ticks included: there the last tick is the same number, the
    earlier ones, which the LSTM has read by then, are not.

    Attributes:
        heads: attention heads; they must divide the channels.

    Raises:
        ConfigError: fewer than one head.
    """

    slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
    space: ClassVar[dict[str, object]] = {"heads": (2, 4)}
    heads: int = 4

    def __post_init__(self) -> None:
        check_bounds("attention_bridge", self, heads=integer(1, MOST_CHANNELS))

    def build(self, width: int, window: int) -> Streaming:
        """Build the bridge on `width` channels."""
        if width % self.heads:
            fitting = [heads for heads in range(1, min(width, 16) + 1) if width % heads == 0]
            raise ConfigError(
                f"attention_bridge: heads = {self.heads} do not divide the {width} channels of the convolutions; "
                f"heads in {fitting} do, or change the last entry of the backbone's channels"
            )
        return _Bridge(width, window, self.heads)


class _Bridge(Streaming):
    """State: ring of keys and of values of the last ``window - 1`` ticks, and a score offset that hides unseen ones."""

    operations = frozenset(
        {Operation.LAYER_NORM, Operation.LINEAR, Operation.MATMUL, Operation.SOFTMAX, Operation.GELU}
    )

    def __init__(self, width: int, window: int, heads: int) -> None:
        super().__init__()
        self.width, self.window, self.heads = width, window, heads
        self.norm_attention, self.norm_feed = nn.LayerNorm(width), nn.LayerNorm(width)
        self.project, self.gather = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.widen, self.narrow = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)
        # PyTorch's start of multi-head attention: Xavier over the joined projections, biases at zero.
        nn.init.xavier_uniform_(self.project.weight)
        for bias in (self.project.bias, self.gather.bias):
            nn.init.zeros_(bias)

    def initial_state(self, batch: int, like: Tensor) -> State:
        past = self.window - 1
        keys = like.new_zeros(batch, past, self.width)
        # Ticks before the reset get an offset that hides them: zeros in the ring would take part in the softmax.
        return keys, keys.clone(), like.new_full((batch, past), UNSEEN)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        ticks = x.shape[1]
        query, key, value = self.project(self.norm_attention(x)).chunk(3, dim=-1)
        keys, values = torch.cat([state[0], key], dim=1), torch.cat([state[1], value], dim=1)
        hidden = torch.cat([state[2], x.new_zeros(len(x), ticks)], dim=1)
        attended = []
        # Blocks bound the memory of the scores, which would grow with the square of the sequence length otherwise.
        for start in range(0, ticks, BLOCK):
            stop = min(start + BLOCK, ticks)
            # The columns that the first query of the block sees start `window - 1` ticks before it, which are in the
            # ring.
            seen = slice(start, stop + self.window - 1)
            attended.append(self._attend(query[:, start:stop], keys[:, seen], values[:, seen], hidden[:, seen]))
        y = x + self.gather(torch.cat(attended, dim=1))
        # The residual is added behind the norm (pre-norm): the path of the gradients past the layer stays free.
        y = y + self.narrow(functional.gelu(self.widen(self.norm_feed(y))))
        return y, (keys[:, ticks:], values[:, ticks:], hidden[:, ticks:])

    def _attend(self, query: Tensor, keys: Tensor, values: Tensor, hidden: Tensor) -> Tensor:
        """Return each query row attends to its own `window` columns: row i to columns i to ``i + window - 1``."""
        (batch, ticks, _), columns = query.shape, keys.shape[1]
        q, k, v = (p.unflatten(-1, (self.heads, -1)).transpose(1, 2).flatten(0, 1) for p in (query, keys, values))
        lag = torch.arange(columns, device=q.device) - torch.arange(ticks, device=q.device)[:, None]
        outside = (lag < 0) | (lag >= self.window)
        offset = hidden[:, None] + hidden.new_zeros(ticks, columns).masked_fill(outside, UNSEEN)
        offset = offset[:, None].expand(-1, self.heads, -1, -1).flatten(0, 1)
        # The scale 1/sqrt(head width) keeps the variance of the scores near one, so that the softmax does not saturate.
        scores = torch.baddbmm(offset, q, k.transpose(1, 2), alpha=1.0 / math.sqrt(q.shape[-1]))
        result: Tensor = (scores.softmax(dim=-1) @ v).unflatten(0, (batch, self.heads)).transpose(1, 2).flatten(2)
        return result

    def lower(self, build: Builder, x: str) -> str:
        wide = self.width
        with build.inside("bridge"):
            calm = _norm(build, "norm1", x, self.norm_attention)
            # Three layers instead of one: an export reads each projection by its own name and width.
            parts = zip(self.project.weight.chunk(3), self.project.bias.chunk(3), strict=True)
            names = ("query", "key", "value")
            qkv = [build.add(Dense, names[i], calm, weight=w, bias=b) for i, (w, b) in enumerate(parts)]
            seen = build.add(WindowAttention, "attention", *qkv, size=wide, heads=self.heads, window=self.window)
            seen = build.add(Dense, "gather", seen, weight=self.gather.weight, bias=self.gather.bias)
            y = build.combine("sum1", BinaryOperation.ADD, x, seen)
            fed = _norm(build, "norm2", y, self.norm_feed)
            fed = build.add(Dense, "widen", fed, weight=self.widen.weight, bias=self.widen.bias)
            fed = build.add(Activate, "gelu", fed, function=Function.GELU, size=2 * wide)
            fed = build.add(Dense, "narrow", fed, weight=self.narrow.weight, bias=self.narrow.bias)
            return build.combine("sum2", BinaryOperation.ADD, y, fed)

    def costs(self) -> list[Cost]:
        """Return the costs of scores and weighted values.

        ``2 W C`` per sample; a window of W samples costs the thesis's ``2 W^2 C``.
        """
        wide, attention = self.width, nn.ModuleList([self.norm_attention, self.project, self.gather])
        feed = nn.ModuleList([self.norm_feed, self.widen, self.narrow])
        return [
            Cost(
                # Query, key, value and output projection take 4 C^2; the thesis's W^2 becomes W for a single new
                # column.
                f"attention bridge, {self.heads} heads over {self.window}",
                parameters_of(attention),
                per_column=4 * wide * wide + 2 * self.window * wide,
                width_in=wide,
                width_out=3 * wide,
            ),
            Cost(
                "bridge feed-forward",
                parameters_of(feed),
                per_column=4 * wide * wide,
                width_in=wide,
                width_out=2 * wide,
            ),
        ]


def _norm(build: Builder, name: str, x: str, norm: nn.LayerNorm) -> str:
    return build.add(LayerNorm, name, x, gain=norm.weight, shift=norm.bias, epsilon=norm.eps)
