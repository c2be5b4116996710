"""Memory plan of a model: locations of values in the work memory, which are reused after the last read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.ir import Graph, Layer
from edp.ir.base import Number


@dataclass(frozen=True)
class MemoryPlan:
    """Places from the start of the work memory of their kind of number.

    Attributes:
        values: position of the value of each layer.
        scratch: position of the scratch numbers of each layer that needs any.
        sizes: sizes of the work memories.
    """

    values: Mapping[str, int]
    scratch: Mapping[str, int]
    sizes: Mapping[Number, int]


def scratch_number(layer: Layer) -> Number:
    """Return the number type of a layer's scratch memory."""
    return Number.FLOAT if layer.number is Number.FLOAT else Number.INT32


def plan(graph: Graph, tangent: bool = False) -> MemoryPlan:
    """Give every value the first gap that is wide enough from where it is made to where it is last read.

    Args:
        graph: the layers.
        tangent: whether the values are those of the tangent along one direction.
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
            (scratch, layer.tangent_scratch if tangent else layer.scratch, at, scratch_number(layer)),
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
