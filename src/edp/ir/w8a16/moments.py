"""Second moments of the inputs of each matrix of a network."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from edp.ir.base import Graph
from edp.ir.layers import GroupedDense

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
            products = layer.products(values[layer.inputs[0]], values[layer.name]) if layer.inputs else {}
            for matrix, x in products.items():
                product = np.einsum("tri,trj->rij", x, x)
                self._sums[matrix] = self._sums.get(matrix, 0.0) + product
        self._ticks += len(next(iter(values.values())))

    def means(self) -> dict[str, Array]:
        """Return the mean moments by matrix, ``(terms, terms)``; for a `GroupedDense` ``(row, terms, terms)``."""
        apart = {layer.name for layer in self.graph.layers if isinstance(layer, GroupedDense)}
        means = {name: total / max(1, self._ticks) for name, total in self._sums.items()}
        return {name: mean if name in apart else mean.mean(axis=0) for name, mean in means.items()}
