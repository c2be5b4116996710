"""Where values lie in a model's work memory: places are used again once nobody reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.graph import Graph, Layer, layers, memory


@dataclass(frozen=True)
class Plan:
    """Places in floats from the start of the work memory.

    Attributes:
        values: of each layer's value.
        scratch: of each layer's scratch numbers, where it needs any.
        size: of the whole.
    """

    values: Mapping[str, int]
    scratch: Mapping[str, int]
    size: int


def scratch_of(layer: Layer) -> int:
    """Numbers that a layer's C function needs while it runs."""
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
        return seen + hidden + len(layer.second_bias)
    return 0


def plan(graph: Graph) -> Plan:
    """Give every value the first gap that is wide enough from where it is made to where it is last read."""
    last = {name: at for at, layer in enumerate(graph.layers) for name in layer.inputs}
    last |= dict.fromkeys(graph.results.values(), len(graph.layers))
    busy: dict[str, tuple[int, int, int]] = {}  # start, stop, the layer after which it is free
    values: dict[str, int] = {}
    scratch: dict[str, int] = {}
    size = 1
    for at, layer in enumerate(graph.layers):
        busy = {name: held for name, held in busy.items() if held[2] >= at}
        for kind, wide, until in (("value", layer.width, last.get(layer.name, at)), ("scratch", scratch_of(layer), at)):
            if not wide:
                continue
            start = _gap(sorted((first, stop) for first, stop, _ in busy.values()), wide)
            busy[f"{kind} {layer.name}"] = (start, start + wide, until)
            (values if kind == "value" else scratch)[layer.name] = start
            size = max(size, start + wide)
    return Plan(values, scratch, size)


def _gap(taken: list[tuple[int, int]], wide: int) -> int:
    start = 0
    for first, stop in taken:
        if first - start >= wide:
            break
        start = max(start, stop)
    return start
