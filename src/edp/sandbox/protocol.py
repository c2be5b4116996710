"""Message protocol: eight bytes of length, JSON, then the data of each array.

Nothing that arrives is evaluated or unpickled. The receiving side states how many bytes of numbers it awaits; JSON and
arrays beyond their bounds, and arrays of anything but dimensionless values, are refused before memory is taken for
them.
"""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.storage.reading import Table

HEADER_BYTES = 1 << 28
"""Maximum size of the JSON in a message: names and descriptions of all columns of a log."""
_LENGTH = struct.Struct("<Q")
_NUMBERS = re.compile(r"[<>|]?(?:f[248]|[iu][1248]|b1)")
"""Pattern of the allowed number types, at most eight bytes. Objects, which would be pickled, and structures are
excluded.
"""
_WRITTEN_BYTES = 1 << 24
"""Maximum number of bytes per write. Some systems refuse single writes of gigabytes."""
Header = Table
ReadInto = Callable[[memoryview], None]
Write = Callable[[Any], None]


def is_plain(array: NDArray[Any]) -> bool:
    """Return whether an array can be sent: one dimension, numbers of at most eight bytes."""
    return array.ndim == 1 and _NUMBERS.fullmatch(array.dtype.str) is not None


def send(write: Write, header: Header, arrays: Sequence[NDArray[Any]] = ()) -> None:
    """Send a message.

    Raises:
        ValueError: JSON of more than `HEADER_BYTES`.
    """
    write(packed(header, arrays))
    for array in arrays:
        if array.size:
            write(np.ascontiguousarray(array).view(np.uint8).data)


def packed(header: Header, arrays: Sequence[NDArray[Any]] = ()) -> bytes:
    """Encode a message without its arrays.

    Raises:
        ValueError: more than `HEADER_BYTES`.
    """
    facts = header | {"arrays": [[array.dtype.str, len(array)] for array in arrays]} if arrays else header
    text = json.dumps(facts).encode()
    if len(text) > HEADER_BYTES:
        raise ValueError(f"names and facts of {len(text)} bytes, more than {HEADER_BYTES}")
    return _LENGTH.pack(len(text)) + text


def receive(read_into: ReadInto, most: int = 0) -> tuple[Header, list[NDArray[Any]]]:
    """Receive one message.

    Args:
        read_into: fills a buffer; raises EOFError where the other side is gone.
        most: bytes of numbers that may come.

    Raises:
        EOFError: the other side is gone.
        ValueError: the data received are not a message, or exceed the limit.
    """
    length = bytearray(_LENGTH.size)
    read_into(memoryview(length))
    (size,) = _LENGTH.unpack(length)
    # Before memory is taken for what the other side announces.
    if size > HEADER_BYTES:
        raise ValueError(f"a message of {size} bytes")
    text = bytearray(size)
    read_into(memoryview(text))
    try:
        header = json.loads(text)
    # Brackets nested thousands deep exhaust the parser's stack.
    except RecursionError as error:
        raise ValueError("a message nested too deeply") from error
    if not isinstance(header, dict):
        raise ValueError(f"a message of {type(header).__name__}")
    arrays = _arrays(header.pop("arrays", ()), most)
    for array in arrays:
        if array.size:
            read_into(array.view(np.uint8).data)
    return header, arrays


def _arrays(announced: Any, most: int) -> list[NDArray[Any]]:
    """Allocate the announced arrays after checking that all of them are within bounds."""
    kinds: list[tuple[np.dtype[Any], int]] = []
    try:
        for kind, count in announced:
            # type() instead of isinstance: True is an int, too.
            if not isinstance(kind, str) or not _NUMBERS.fullmatch(kind) or type(count) is not int or count < 0:
                raise ValueError(f"an array of {kind!r}, {count!r} long")
            kinds.append((np.dtype(kind), count))
    except TypeError as error:
        raise ValueError("arrays that are no list") from error
    # All arrays together: many small ones may be as large as one that is refused.
    total = sum(kind.itemsize * count for kind, count in kinds)
    if total > most:
        raise ValueError(f"{total} bytes of numbers where {most} were asked for")
    return [np.empty(count, dtype=kind) for kind, count in kinds]


def reader(handle: int) -> ReadInto:
    """Return a function that fills buffers from a pipe."""
    if hasattr(os, "readv"):

        def read_into(view: memoryview) -> None:
            while view:
                count = os.readv(handle, [view])
                if not count:
                    raise EOFError
                view = view[count:]
    else:

        def read_into(view: memoryview) -> None:
            while view:
                part = os.read(handle, len(view))
                if not part:
                    raise EOFError
                view[: len(part)] = part
                view = view[len(part) :]

    return read_into


def writer(handle: int) -> Write:
    """Return a function that writes a whole buffer to a pipe."""

    def write(data: Any) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(handle, view[:_WRITTEN_BYTES]) :]

    return write
