"""Second moments of the inputs of each matrix of a network."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from edp.ir import layers, memory
from edp.ir.base import Graph, Layer

Array = NDArray[np.floating]


class InputMoments:
    """Accumulator of ``x x'`` for every matrix of a graph, segment by segment.

    Args:
        graph: the float network.
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._sums: dict[str, Array] = {}
        self._ticks = 0

    def add(self, values: Mapping[str, Array]) -> None:
        """Add a segment that begins with a reset: values ``(time, number)`` of every layer."""
        for layer in self.graph.layers:
            for matrix, x in _list_matrix_inputs(layer, values).items():
                product = np.einsum("tri,trj->rij", x, x)
                self._sums[matrix] = self._sums.get(matrix, 0.0) + product
        self._ticks += len(next(iter(values.values())))

    def means(self) -> dict[str, Array]:
        """Return the mean moments by matrix, ``(terms, terms)``; for a `GroupedDense` ``(row, terms, terms)``."""
        apart = {layer.name for layer in self.graph.layers if isinstance(layer, layers.GroupedDense)}
        means = {name: total / max(1, self._ticks) for name, total in self._sums.items()}
        return {name: mean if name in apart else mean.mean(axis=0) for name, mean in means.items()}


def _list_matrix_inputs(layer: Layer, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return the inputs of the matrices of a layer, ``(time, row, terms)``."""
    if not layer.inputs:
        return {}
    x = values[layer.inputs[0]]
    if isinstance(layer, layers.Dense):
        return {layer.name: x.reshape(len(x), layer.rows, -1)}
    if isinstance(layer, layers.GroupedDense):
        return {layer.name: x.reshape(len(x), len(layer.bias), -1)}
    if isinstance(layer, memory.Convolution):
        _, taps, into = layer.weight.shape
        history = np.concatenate([np.zeros(((taps - 1) * layer.dilation, into)), x])
        seen = [history[tap * layer.dilation :][: len(x)] for tap in range(taps)]
        return {layer.name: np.concatenate(seen, axis=1)[:, None]}
    if isinstance(layer, memory.Lstm | memory.Gru):
        h = values[layer.name]
        before = np.concatenate([np.zeros_like(h[:1]), h[:-1]])
        return {f"{layer.name}/x": x[:, None], f"{layer.name}/h": before[:, None]}
    if isinstance(layer, memory.AttentionPool):
        return {layer.name: x[:, None]}
    return {}
