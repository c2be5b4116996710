"""Rescaling of trees and their weights for 8-bit weights, without changing the network function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.ir.base import Graph, Layer
from edp.ir.layers import Dense, Gather, TreeSums


def balanced(graph: Graph) -> Graph:
    """Return an equivalent network with larger leaves if trees have larger weights than other inputs of a layer.

    The 8-bit weights of an output have a common scale. With a weight of 1 for the trees, the weights of a linear model
    (a few hundredths) would keep only two or three bits. Leaves are multiplied by a power of two and the weights
    divided by it, which is exact in single precision. A second call changes nothing.
    """
    changed = {layer.name: layer for layer in graph.layers}
    for layer in graph.layers:
        if not isinstance(layer, TreeSums):
            continue
        join = _only_reader(graph, layer)
        reader = None if join is None else _only_reader(graph, join)
        # As it stands by now: trees before these may have changed it.
        dense = None if reader is None else changed[reader.name]
        if isinstance(join, Gather) and isinstance(dense, Dense) and dense.rows == 1:
            columns = _columns(graph, join, layer.name)
            weight = np.abs(dense.weight)
            own, others = weight[:, columns].max(initial=0.0), weight[:, ~columns].max(initial=0.0)
            if own > others > 0.0:
                factor = np.float32(2.0 ** math.floor(math.log2(own / others)))
                changed[layer.name] = replace(layer, leaf=layer.leaf * factor)
                share = np.where(columns, 1 / factor, np.float32(1.0)).astype(np.float32)
                changed[dense.name] = replace(dense, weight=dense.weight * share)
    return replace(graph, layers=tuple(changed.values()))


def _only_reader(graph: Graph, layer: Layer) -> Layer | None:
    """Return the only layer that reads a value; None if there are others, or the value is a result."""
    readers: Sequence[Layer] = [other for other in graph.layers if layer.name in other.inputs]
    return readers[0] if len(readers) == 1 and layer.name not in graph.results.values() else None


def _columns(graph: Graph, join: Gather, value: str) -> np.ndarray:
    """Return a mask of the elements of a joined value that belong to an input."""
    owners = np.repeat(np.array(join.inputs), [graph.width_of(name) for name in join.inputs])
    return np.asarray(owners[list(join.columns)] == value)
