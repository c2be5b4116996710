"""Builder of layer graphs, whose layer names state the position in the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from edp.errors import ExportError
from edp.ir.base import INPUT, Array, Graph, Indices, Layer, Slot
from edp.ir.layers import BinaryOperation, Elementwise, Gather


def constant(values: Any) -> Array:
    """Return values, an array or a tensor as a new float32 array.

    Raises:
        ExportError: one of them is not finite.
    """
    plain = values.detach().cpu().numpy() if hasattr(values, "detach") else values
    # Copy in C order, so that the graph does not change when training continues with the same tensors.
    array = np.array(plain, dtype=np.float32, order="C")
    # A weight that is not finite would make every prediction NaN on the controller, long after the export.
    if not np.isfinite(array).all():
        raise ExportError("a weight of the network is NaN or infinite; train again before exporting")
    return array


MAX_INDEX = 2**16 - 1
"""Maximum index in a table. Tables of 16-bit indices need half the flash memory of 32-bit tables."""


def indices(values: Any) -> Indices:
    """Return integers, an array or a tensor as a new uint16 array.

    Raises:
        ExportError: one of them is not from 0 to `MAX_INDEX`.
    """
    array = np.asarray(values.detach().cpu().numpy() if hasattr(values, "detach") else values)
    if array.size and not 0 <= array.min() <= array.max() <= MAX_INDEX:
        raise ExportError(
            f"an index of the network is {array.max() if array.min() >= 0 else array.min()}; 0 to {MAX_INDEX} must "
            "hold: let it read fewer columns"
        )
    return np.array(array, dtype=np.uint16, order="C")


class Builder:
    """Layers in the making; parts of a network add theirs in ``lower(build, x)``.

    Args:
        inputs: numbers fed at each tick.
    """

    def __init__(self, inputs: int) -> None:
        self.inputs = inputs
        self.layers: list[Layer] = []
        self._initial: dict[tuple[str, str], Array] = {}
        self._scope: list[str] = []

    @contextmanager
    def inside(self, name: str) -> Iterator[None]:
        """Return the names of layers added within begin with `name`."""
        self._scope.append(name)
        try:
            yield
        finally:
            self._scope.pop()

    def add(self, kind: type[Layer], name: str, *inputs: str, **options: Any) -> str:
        """Add a layer. Arrays among `options` become float constants; arrays of `indices` are unchanged.

        Returns:
            The name of its value.
        """
        full = ".".join([*self._scope, name])
        layer_names = {layer.name for layer in self.layers}
        if full in layer_names or full == INPUT:
            full = next(f"{full}_{n}" for n in range(2, len(layer_names) + 3) if f"{full}_{n}" not in layer_names)
        # Options with a shape are arrays or tensors; plain numbers and tuples are part of the layer's meaning.
        layer_options = {key: constant(value) if _is_real(value) else value for key, value in options.items()}
        self.layers.append(kind(name=full, inputs=inputs, **layer_options))
        return full

    def combine(self, name: str, operation: BinaryOperation, a: str, b: str) -> str:
        """Return two values of the same width, number by number."""
        return self.add(Elementwise, name, a, b, operation=operation, size=self.width(a))

    def pick(self, name: str, x: str, columns: Sequence[int]) -> str:
        """Select elements of a value; the value itself is returned if all are selected in order."""
        chosen = tuple(columns)
        # Omit a gather that changes nothing; it would cost a copy per sample in the exported code.
        if chosen == tuple(range(self.width(x))):
            return x
        return self.add(Gather, name, x, columns=chosen)

    def join(self, name: str, *parts: str) -> str:
        """Return the values end to end."""
        if len(parts) == 1:
            return parts[0]
        return self.add(Gather, name, *parts, columns=tuple(range(sum(map(self.width, parts)))))

    def width(self, value: str) -> int:
        """Return the number of elements of a value."""
        return self.inputs if value == INPUT else next(x.width for x in self.layers if x.name == value)

    def slots_since(self, count: int) -> list[tuple[str, Slot]]:
        """Return the slots of the layers after the first `count`, in order."""
        return [(layer.name, slot) for layer in self.layers[count:] for slot in layer.slots]

    def start_from(self, slots: Sequence[tuple[str, Slot]], numbers: Any) -> None:
        """Set the initial values of these slots to `numbers`, one slot after the other."""
        values, at = constant(numbers).ravel(), 0
        for layer, slot in slots:
            self._initial[layer, slot.name] = values[at : at + slot.size].reshape(slot.shape)
            at += slot.size
        if at != values.size:
            raise ExportError(f"{values.size} numbers for the state at reset, but the layers remember {at}")

    def graph(self, results: dict[str, str], window: int) -> Graph:
        """Return the finished graph without unread layers."""
        used_layers: list[Layer] = []
        used_values = set(results.values())
        for layer in reversed(self.layers):
            # Layers of width zero change the memory of others. Their value is not read, but they must stay.
            if layer.name in used_values or not layer.width:
                used_layers.append(layer)
                used_values |= set(layer.inputs)
        # Copy the layers, because the builder may continue to change its own.
        return Graph(
            self.inputs, tuple(replace(layer) for layer in reversed(used_layers)), results, self._initial, window
        )


def _is_real(value: Any) -> bool:
    """Return whether an option is an array or tensor of real values."""
    return hasattr(value, "shape") and value.dtype != np.uint16
