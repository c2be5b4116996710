"""Memory plan of a model: locations of values in the work memory, which are reused after the last read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from edp.ir import Graph, Layer, layers, memory
from edp.ir.base import Number
from edp.ir.w8a16 import layers as quantised


@dataclass(frozen=True)
class MemoryPlan:
    """Places from the start of the work memory of their kind of number.

    Attributes:
        values: of each layer's value.
        scratch: of each layer's scratch numbers, where it needs any.
        sizes: of the work memories.
    """

    values: Mapping[str, int]
    scratch: Mapping[str, int]
    sizes: Mapping[Number, int]


def scratch_of(layer: Layer) -> int:
    """Numbers that a layer's C function needs while it runs."""
    # Four gates; the layer norm keeps the sums of both sides apart, the GRU those of its two products.
    if isinstance(layer, memory.Lstm):
        return 4 * layer.width
    if isinstance(layer, memory.LayerNormLstm):
        return 8 * layer.width
    if isinstance(layer, memory.Gru):
        return 6 * layer.width
    if isinstance(layer, memory.AttentionPool | memory.WindowAttention):
        return layer.window
    if isinstance(layer, layers.RowAttention):
        return layer.rows
    if isinstance(layer, memory.PrefixCorrection):
        hidden, seen = layer.first_weight.shape
        return int(seen + hidden + len(layer.second_bias))
    return _integer_scratch(layer)


def _integer_scratch(layer: Layer) -> int:
    if isinstance(layer, quantised.QDense | quantised.QConvolution):
        return len(layer.bias)
    if isinstance(layer, quantised.QGroupedDense):
        return int(layer.bias.shape[1])
    if isinstance(layer, quantised.QLstm):
        return 8 * layer.width
    if isinstance(layer, quantised.QGru):
        return 6 * layer.width
    return layer.window if isinstance(layer, quantised.QAttentionPool) else 0


def scratch_number(layer: Layer) -> Number:
    """Return the number type of a layer's scratch memory."""
    return Number.FLOAT if layer.number is Number.FLOAT else Number.INT32


def plan(graph: Graph, scratch_of: Callable[[Layer], int] = scratch_of) -> MemoryPlan:
    """Give every value the first gap that is wide enough from where it is made to where it is last read.

    Args:
        graph: the layers.
        scratch_of: scratch numbers that a layer needs beside its value.
    """
    last = {name: at for at, layer in enumerate(graph.layers) for name in layer.inputs}
    # Results are read after the last layer, when they are copied out.
    last |= dict.fromkeys(graph.results.values(), len(graph.layers))
    busy: list[tuple[Number, int, int, int]] = []  # start, stop, the layer after which it is free
    values: dict[str, int] = {}
    scratch: dict[str, int] = {}
    sizes: dict[Number, int] = {}
    for at, layer in enumerate(graph.layers):
        # A value may be overwritten by the layer after its last reader, never by that reader itself.
        busy = [block for block in busy if block[3] >= at]
        for places, wide, until, number in (
            (values, layer.width, last.get(layer.name, at), layer.number),
            (scratch, scratch_of(layer), at, scratch_number(layer)),
        ):
            if not wide:
                continue
            # The first gap that fits: equal networks get equal plans.
            start = _gap(sorted((first, stop) for kind, first, stop, _ in busy if kind is number), wide)
            busy.append((number, start, start + wide, until))
            places[layer.name] = start
            sizes[number] = max(sizes.get(number, 0), start + wide)
    return MemoryPlan(values, scratch, sizes)


def _gap(busy: list[tuple[int, int]], wide: int) -> int:
    start = 0
    for first, stop in busy:
        if first - start >= wide:
            break
        start = max(start, stop)
    return start
