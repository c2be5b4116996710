"""Layer graph: layers, their states, and the list of layers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Indices = NDArray[np.uint16]
Values = NDArray[Any]
"""Values of a layer for several samples and streams, ``(time, stream, number)``."""
Memory = dict[str, Any]
"""Memory of a layer by slot: ``(stream, ...)``, ring buffers ``(tick, stream, ...)``. An age is one number for all
streams."""

INPUT = "input"
"""Name of the value that contains the inputs of the current sample, SI units, in input order."""


class Number(StrEnum):
    """Number type of a value or slot."""

    FLOAT = "float"
    INT16 = "int16"
    INT32 = "int32"

    @property
    def bytes(self) -> int:
        """Size of one number in bytes."""
        # Only activations are 16-bit; single precision and 32-bit states take four bytes.
        return 2 if self is Number.INT16 else 4


@dataclass(frozen=True)
class Slot:
    """Numbers that a layer carries from tick to tick.

    Attributes:
        name: name within the layer.
        shape: shape; a ring has samples first, the oldest one in row 0.
        fill: value of every number after a reset, unless the graph has another value.
        number: meaning of the values.
    """

    name: str
    shape: tuple[int, ...]
    fill: float = 0.0
    number: Number = Number.FLOAT

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape))


class Arithmetic(ABC):
    """Float arithmetic of an interpreter: element-wise functions and the order of sums."""

    @abstractmethod
    def apply(self, function: str, x: Values) -> Values:
        """Return a function of each number; see `edp.ir.layers.Function`."""

    @abstractmethod
    def combine(self, operation: str, a: Values, b: Values) -> Values:
        """Combine two values number by number; see `edp.ir.layers.BinaryOperation`."""

    @abstractmethod
    def total(self, x: Values, axis: int = -1) -> Values:
        """Return sums over an axis."""

    def softmax(self, scores: Values) -> Values:
        """Return weights that sum to 1 over the last axis."""
        # Subtracting the largest score keeps exp below one; the weights do not change.
        raised = self.apply("exp", scores - scores.max(axis=-1, keepdims=True))
        return np.asarray(raised / self.total(raised)[..., None])

    def normed(self, x: Values, epsilon: float) -> Values:
        """Return each row less its mean, over the root of its variance plus `epsilon`."""
        count = x.dtype.type(x.shape[-1])
        middle = x - (self.total(x) / count)[..., None]
        scale = x.dtype.type(1.0) / np.sqrt(self.total(middle * middle) / count + x.dtype.type(epsilon))
        return np.asarray(middle * scale[..., None])


@dataclass(frozen=True, eq=False)
class LayerRun:
    """State and options of one run of a layer's equations, in addition to its inputs.

    Attributes:
        constants: constants of the layer, in the number type of the interpreter.
        memory: memory of the layer, which is updated.
        others: memories of all layers, by name.
        arithmetic: functions and sums.
    """

    constants: Mapping[str, Values]
    memory: Memory
    others: Mapping[str, Memory]
    arithmetic: Arithmetic


def _refuse_equations(layer: Layer, run: LayerRun, *inputs: Values) -> Values:
    """Refuse to compute a kind of layer without equations.

    Raises:
        NotImplementedError: always.
    """
    raise NotImplementedError(f"layer '{layer.name}' is a {type(layer).__name__}, which has no equations")


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer(ABC):
    """One computation of a tick: vectors in, one vector out.

    Attributes:
        name: name of the layer and of its value; unique in its graph, lower case, parts joined by dots.
        inputs: names of the values that the layer reads.
        matrices: names of the weight matrices, which the C runtime stores in panels.
        counted: whether its C state has a ring buffer or a counter.
        stays_float: whether it stays in single precision in an integer network: it has no weights, or a few gains.
        bit_exact: whether its equations in the arithmetic of the C runtime are bit-identical to the C code.
        tick_by_tick: whether the equations compute one sample at a time, because other layers depend on their changes.
        without: unsupported forms of this kind of layer (``integers``, ``tangent``, ``onnx``, ``matlab``), each with
            the suggested alternative.
    """

    matrices: ClassVar[tuple[str, ...]] = ()
    counted: ClassVar[bool] = False
    stays_float: ClassVar[bool] = False
    bit_exact: ClassVar[bool] = False
    tick_by_tick: ClassVar[bool] = False
    without: ClassVar[Mapping[str, str]] = {}

    over_time: ClassVar[Callable[..., Any]] = _refuse_equations
    """Method ``over_time(run, *inputs)`` that computes the layer's values from its inputs, both ``(time, stream,
    number)``; `run` is a `LayerRun`."""

    name: str
    inputs: tuple[str, ...]

    @property
    @abstractmethod
    def width(self) -> int:
        """Numbers that it gives."""

    @property
    def kind(self) -> str:
        """The word for it in exported files and in their hash of the network."""
        return type(self).__name__

    @property
    def number(self) -> Number:
        """Number type of the layer's value."""
        return Number.FLOAT

    @property
    def slots(self) -> tuple[Slot, ...]:
        """State slots of the layer."""
        return ()

    @property
    def macs(self) -> int:
        """Multiply-accumulates per sample with weights or state; element-wise work is not counted."""
        return 0

    @property
    def scratch(self) -> int:
        """Number of work elements that its C function needs while it runs."""
        return 0

    @property
    def tangent_scratch(self) -> int:
        """Number of work elements of its tangent along one direction; the first direction includes the common part."""
        return self.scratch

    def products(self, x: Values, y: Values) -> dict[str, Values]:
        """Return the inputs of its 8-bit matrices, ``(time, row, terms)``, by matrix.

        Args:
            x: its first input since a reset, ``(time, number)``.
            y: its value, ``(time, number)``.
        """
        return {}

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Return the constant arrays of the layer by name."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def options(self) -> dict[str, object]:
        """Return the options of the layer by name, without its constant arrays."""
        arrays = self.tensors()
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name not in arrays}


@dataclass(frozen=True, eq=False)
class Graph:
    """Layers in the order in which a tick computes them.

    Attributes:
        inputs: numbers fed at each tick.
        layers: every layer reads `INPUT` and layers before it.
        results: values that the graph returns, by meaning: ``prediction``, and ``lower`` and ``upper`` bounds.
        initial: values of slots after a reset that are not all one number, by ``(layer, slot)``.
        window: ticks after a reset until predictions rest on a whole window.
    """

    inputs: int
    layers: tuple[Layer, ...]
    results: Mapping[str, str]
    initial: Mapping[tuple[str, str], NDArray[Any]] = field(default_factory=dict)
    window: int = 1

    def layer(self, name: str) -> Layer:
        """Return a layer by name.

        Raises:
            KeyError: there is none.
        """
        for layer in self.layers:
            if layer.name == name:
                return layer
        raise KeyError(name)

    def width_of(self, value: str) -> int:
        """Return the number of elements of a value."""
        return self.inputs if value == INPUT else self.layer(value).width

    def tensors(self) -> Iterator[tuple[str, str, NDArray[Any]]]:
        """Return every constant array: layer, name within it, values."""
        for layer in self.layers:
            for name, values in layer.tensors().items():
                yield layer.name, name, values

    def slots(self) -> Iterator[tuple[str, Slot]]:
        """Return everything carried from tick to tick: layer and slot."""
        for layer in self.layers:
            for slot in layer.slots:
                yield layer.name, slot

    def start(self, layer: str, slot: Slot) -> NDArray[Any]:
        """Return the values of a slot after a reset."""
        # Slots without a learned start take their fill, so that graphs list only what differs.
        return self.initial.get((layer, slot.name), np.full(slot.shape, slot.fill, dtype=np.float32))

    @property
    def fed_back(self) -> bool:
        """Whether a sample reads an output of the previous sample, as a plant model does."""
        return any(layer.kind == "Feed" for layer in self.layers)

    @property
    def parameters(self) -> int:
        """Numbers in all constant arrays."""
        return sum(values.size for _, _, values in self.tensors())

    @property
    def macs(self) -> int:
        """Multiply-accumulates of one tick."""
        return sum(layer.macs for layer in self.layers)
