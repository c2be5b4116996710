"""Reference implementation of W8A16 networks, bit for bit, over many samples: the definition for exported code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.ir.arithmetic import RUNTIME
from edp.ir.base import Graph
from edp.ir.reference import Interpreter


class Integers(Interpreter):
    """Streams side by side through a graph of `edp.ir.w8a16.quantise`.

    Args:
        graph: the layers.
        streams: number of streams.
    """

    def __init__(self, graph: Graph, streams: int = 1) -> None:
        super().__init__(graph, RUNTIME, np.float32, streams)

    @property
    def clipped(self) -> int:
        """Numbers that were beyond the range of their format since the reset, of all ticks and streams."""
        return sum(memory.get("clipped", 0) for memory in self.memory.values())

    def run(self, inputs: NDArray[np.floating]) -> dict[str, NDArray[np.float32]]:
        """Feed ticks ``(time, stream, input)`` in SI units; returns results ``(time, stream, number)`` by meaning."""
        values = self.values(inputs)
        return {meaning: values[name] for meaning, name in self.graph.results.items()}
