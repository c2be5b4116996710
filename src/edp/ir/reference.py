"""Interpreter of layer graphs in NumPy, and the reference of float networks, sample by sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.ir.arithmetic import EXACT
from edp.ir.base import INPUT, Arithmetic, Graph, LayerRun, Memory, Number, Values

RINGS = ("ring", "scores", "keys", "values")
"""Names of the memory slots whose first dimension is time."""


class Interpreter:
    """Streams side by side through a graph.

    Args:
        graph: the layers.
        arithmetic: arithmetic of the layers that compute with floats.
        dtype: number type of their values.
        streams: number of streams.

    Attributes:
        memory: memory of each layer, by its name.
    """

    def __init__(self, graph: Graph, arithmetic: Arithmetic, dtype: type[np.floating], streams: int = 1) -> None:
        self.graph, self.arithmetic, self.dtype, self.streams = graph, arithmetic, dtype, streams
        self._constants = {
            layer.name: {
                name: values.astype(dtype) if layer.number is Number.FLOAT else values
                for name, values in layer.tensors().items()
            }
            for layer in graph.layers
        }
        self.reset()

    def reset(self) -> None:
        """Forget all ticks."""
        self.memory: dict[str, Memory] = {layer.name: {} for layer in self.graph.layers}
        for name, slot in self.graph.slots():
            start = self.graph.start(name, slot).astype(self.dtype if slot.number is Number.FLOAT else np.int64)
            if slot.name != "age":
                start = np.stack([start] * self.streams, axis=int(slot.name in RINGS))
            self.memory[name][slot.name] = start
        self._runs = [
            (layer, LayerRun(self._constants[layer.name], self.memory[layer.name], self.memory, self.arithmetic))
            for layer in self.graph.layers
        ]

    def values(self, inputs: Values) -> dict[str, Values]:
        """Feed ticks ``(time, stream, input)`` in SI units; returns the value of every layer and the input."""
        if len(inputs) == 1 or not any(layer.tick_by_tick for layer in self.graph.layers):
            return self._together(inputs)
        ticks = [self._together(inputs[at : at + 1]) for at in range(len(inputs))]
        return {name: np.concatenate([tick[name] for tick in ticks]) for name in (ticks[0] if ticks else ())}

    def _together(self, inputs: Values) -> dict[str, Values]:
        """Return all ticks at once, layer by layer."""
        values: dict[str, Values] = {INPUT: np.asarray(inputs, dtype=self.dtype)}
        for layer, run in self._runs:
            values[layer.name] = layer.over_time(run, *[values[name] for name in layer.inputs])
        return values


class Reference(Interpreter):
    """Sample-by-sample simulation of a float graph. It is slow and used by tests and quantisation.

    Args:
        graph: the layers.
        dtype: float64 for the exact result of the graph, float32 for its result in single precision.
    """

    # Double precision by default: single-precision forms are compared with the reference, so its rounding errors must
    # be negligible.
    def __init__(self, graph: Graph, dtype: type[np.floating] = np.float64) -> None:
        super().__init__(graph, EXACT, dtype)

    def step(self, inputs: NDArray[np.floating]) -> dict[str, Values]:
        """Feed one tick ``(input,)`` in SI units; returns the value of every layer and the input, ``(number,)``."""
        values = self.values(np.asarray(inputs)[None, None])
        return {name: value[0, 0] for name, value in values.items()}

    def results(self, inputs: NDArray[np.floating]) -> dict[str, Values]:
        """Process one sample and return the results of the graph by meaning."""
        values = self.step(inputs)
        return {meaning: values[name] for meaning, name in self.graph.results.items()}
