"""What a helper process sends back: eight bytes of length, JSON, then the numbers of each array."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.matlab.found import Found, Part

_LENGTH = struct.Struct("<Q")
_KINDS = "fiub"
_PLAIN = ("scalars", "repeated", "names", "info")
Write = Callable[[Any], object]
ReadInto = Callable[[memoryview], None]


def pack(found: Found) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """The facts and the arrays to send; an array that several columns share is sent once."""
    arrays: list[NDArray[Any]] = []
    places: dict[int, int] = {}

    def place(array: NDArray[Any]) -> int:
        if id(array) not in places:
            places[id(array)] = len(arrays)
            arrays.append(np.ascontiguousarray(array))
        return places[id(array)]

    signals = [
        [part.name, part.unit, place(part.values), None if part.time is None else place(part.time)]
        for part in found.signals
    ]
    facts = {name: getattr(found, name) for name in _PLAIN}
    return {"signals": signals, "arrays": [[array.dtype.str, len(array)] for array in arrays], **facts}, arrays


def send(packed: tuple[dict[str, Any], list[NDArray[Any]]], write: Write) -> None:
    """Send what `pack` made."""
    _say(packed[0], write)
    for array in packed[1]:
        if array.size:
            write(array.view(np.uint8).data)


def refuse(message: str, write: Write) -> None:
    """Send what is wrong with the file instead."""
    _say({"refused": message}, write)


def receive(read_into: ReadInto) -> Found | str:
    """What was found, or what is wrong with the file.

    Raises:
        EOFError: `read_into` raises it where the other side is gone.
        ValueError: what came is not what `send` sends.
    """
    length = bytearray(_LENGTH.size)
    read_into(memoryview(length))
    text = bytearray(_LENGTH.unpack(length)[0])
    read_into(memoryview(text))
    try:
        told = json.loads(text)
        if "refused" in told:
            return str(told["refused"])
        arrays = [_array(kind, count) for kind, count in told["arrays"]]
        for array in arrays:
            if array.size:
                read_into(array.view(np.uint8).data)
        signals = [
            Part(name, arrays[values], None if time is None else arrays[time], unit)
            for name, unit, values, time in told["signals"]
        ]
        return Found(signals, **{name: told[name] for name in _PLAIN})
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _array(kind: str, count: int) -> NDArray[Any]:
    dtype = np.dtype(kind)
    if dtype.kind not in _KINDS:
        raise ValueError(f"an array of {kind}")
    return np.empty(count, dtype=dtype)


def _say(facts: dict[str, Any], write: Write) -> None:
    text = json.dumps(facts).encode()
    write(_LENGTH.pack(len(text)))
    write(text)
