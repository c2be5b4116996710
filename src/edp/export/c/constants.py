"""The constants of a model as its C code declares them: one list, from which they are written and counted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.export.c import integer_calls
from edp.export.c.calls import Calls, constant, needs_columns, slot, structs
from edp.export.c.layout import laid
from edp.export.c.plan import MemoryPlan
from edp.export.c.text import array, initialiser, number, unsigned_literals
from edp.ir import Graph, Layer

TYPES = {
    "float32": "float",
    "int8": "int8_t",
    "int16": "int16_t",
    "int32": "int32_t",
    "uint8": "uint8_t",
    "uint16": "uint16_t",
}
"""C types of the constants by array data type."""
NUMBER_BYTES = {"float": 4, "int8_t": 1, "uint8_t": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4}
STRUCTS = {
    "edp_table": (1, 2),
    "edp_lstm_weights": (3, 1),
    "edp_lstm_norms": (4, 1),
    "edp_gru_weights": (4, 0),
    "edp_prefix_weights": (4, 3),
    "edp_q_matrix": (3, 0),
    "edp_q_recurrent": (8, 1),
    "edp_adapt_law": (10, 14),
    "edp_hydraulics": (16, 15),
}
"""Number of pointers, and number of 4-byte values after them, in the structs of the runtime."""


@dataclass(frozen=True)
class DataModel:
    """Data layout of a compiler for constants.

    Attributes:
        pointer: bytes of a pointer.
        boundary: a multiple of so many bytes is where each constant begins.
    """

    pointer: int
    boundary: int


CORTEX_M = DataModel(pointer=4, boundary=4)
"""32-bit Arm cores. GCC aligns every constant to a word (``DATA_ALIGNMENT`` of its Arm back end; not with -Os)."""
DESKTOP = DataModel(pointer=8, boundary=1)
"""64-bit computers, without gaps between constants, since their alignment depends on the compiler."""


@dataclass(frozen=True, eq=False)
class CConstant:
    """A constant of a model.

    Attributes:
        kind: C type of its entries.
        name: name in C.
        count: entries.
        text: its definition; empty where a template holds it.
    """

    kind: str
    name: str
    count: int
    text: str = ""

    def bytes_on(self, machine: DataModel) -> int:
        """Return the size on a machine in bytes, up to the next constant."""
        if self.kind in STRUCTS:
            pointers, numbers = STRUCTS[self.kind]
            # A struct is as aligned as its pointers.
            each = _round_up(pointers * machine.pointer + 4 * numbers, machine.pointer)
        else:
            each = NUMBER_BYTES[self.kind]  # scalars and arrays
        return _round_up(self.count * each, machine.boundary)


def total_bytes(constants: Iterator[CConstant] | list[CConstant], machine: DataModel = CORTEX_M) -> int:
    """Return the size of constants in read-only memory."""
    return sum(one.bytes_on(machine) for one in constants)


def constants_of(graph: Graph, plan: MemoryPlan, written: bool = False) -> Iterator[CConstant]:
    """Yield all constants of a model in the order of the C code, constants of ``NAME_weights.h`` first.

    Args:
        graph: its layers.
        plan: places in the work memory.
        written: whether to return their texts, which take time, instead of counting only.
    """
    calls = Calls(graph, plan)
    for layer in graph.layers:
        for name, values in layer.tensors().items():
            yield _tensor(layer, name, values, written)
        if needs_columns(calls, layer):
            # 16-bit columns: half of the flash of a table of words.
            columns, name = layer.columns, constant(layer, "columns")  # type: ignore[attr-defined]
            text = array("uint16_t", name, unsigned_literals(columns)) if written else ""
            yield CConstant("uint16_t", name, len(columns), text)
        for line in structs(layer) + integer_calls.structs(layer):
            # The declaration is the single source of the name; counting reads it back instead of naming it twice.
            _, _, kind, name, *_ = line.split()  # static const KIND NAME = ...
            yield CConstant(kind, name, 1, line)
    for (layer_name, part), values in graph.initial.items():
        start = slot(layer_name, part).removeprefix("s->") + "_start"
        yield CConstant(TYPES[values.dtype.name], start, values.size, _array(start, values) if written else "")
    # The table of tensors exists for the checksum at start-up, so it counts as a constant too.
    yield _tables(graph)
    for name in ("input_low", "input_high"):
        yield CConstant("float", name, graph.inputs)


def stored(layer: Layer, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return the elements of a constant in the order of the C code."""
    return laid(layer, name, integer_calls.lay_out(layer, values))


def _tensor(layer: Layer, name: str, values: NDArray[Any], written: bool) -> CConstant:
    full, note = constant(layer, name), " x ".join(map(str, values.shape))
    text = _array(full, stored(layer, name, values), note) if written else ""
    return CConstant(TYPES[values.dtype.name], full, values.size, text)


def _tables(graph: Graph) -> CConstant:
    """Return the table of tensor locations for the checksum."""
    entries = [
        initialiser([constant(layer, name), *unsigned_literals((values.size, values.itemsize))])
        for layer in graph.layers
        for name, values in layer.tensors().items()
    ]
    return CConstant("edp_table", "tables", len(entries), array("edp_table", "tables", entries))


def _array(name: str, values: NDArray[Any], note: str = "") -> str:
    kind = TYPES[values.dtype.name]
    flat: NDArray[Any] = np.ravel(values)
    items = map(number, flat) if kind == "float" else (_integer(value) for value in flat.tolist())
    return array(kind, name, items, note)


def _integer(value: int) -> str:
    # The literal of the least 32-bit number would not fit before its sign.
    return "(-2147483647 - 1)" if value == -(2**31) else str(value)


def _round_up(size: int, multiple: int) -> int:
    """Round a number of bytes up to the next multiple."""
    return -(-size // multiple) * multiple
