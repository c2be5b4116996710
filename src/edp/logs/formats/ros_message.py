"""Numbers out of serialised ROS messages, many messages at a time.

Where a message type holds no text and no list of varying length, each number lies at the same byte of every message;
where it does, messages of equal lengths still agree. So the first message is walked field by field, and all messages
with the same lengths at the same places are read as columns. Layouts: CDR (ROS 2; numbers aligned to their size behind
a header of 4 bytes) and ROS 1 (no alignment, no header).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError

LARGEST_ARRAY = 256
"""Maximum length of a list that becomes columns. Longer lists are pictures or point clouds."""
_DTYPES = {
    "bool": "u1",
    "byte": "u1",
    "octet": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4
_DEEPEST = 32
"""Maximum nesting depth of types. ROS types have about six levels."""
_MAX_STEPS = 100_000
"""Maximum number of fields of a message, including list elements. Only nested lists can have more."""


class LongMessageError(DataError):
    """Message with more values than signal samples have, such as a plan, a map or a point cloud."""


class Types(Protocol):
    """Part of the interface of a message type store."""

    fielddefs: Mapping[str, tuple[Any, Sequence[tuple[str, Any]]]]


@dataclass
class MessageLayout:
    """Positions of the values in a message.

    Attributes:
        fields: path of each number, such as ``twist.linear.x`` or ``data_1``, with its first byte and dtype.
        fixed: bytes that other messages must share for the layout to hold: lengths of texts and lists, names.
        size: length of the message in bytes.
    """

    fields: dict[str, tuple[int, str]] = field(default_factory=dict)
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    size: int = 0


def layout_of(raw: bytes, message_type: str, types: Types, cdr: bool) -> MessageLayout:
    """Walk one message.

    Args:
        raw: the message.
        message_type: its type, such as ``std_msgs/msg/Float64``.
        types: the definitions of it and of the types in it.
        cdr: laid out as in ROS 2, else as in ROS 1.

    Raises:
        DataError: the message does not fit its type.
    """
    try:
        walk = _Walk(bytes(raw), types, cdr)
        walk.message(message_type, "", 0)
        # CDR may fill the message up to the next multiple of 4.
        if walk.at > len(raw) or walk.at + 4 <= len(raw):
            raise DataError(f"a message of {len(raw)} bytes, its type has {walk.at}")
    except (struct.error, KeyError, UnicodeDecodeError) as error:
        raise DataError(f"a message that does not fit its type {message_type} ({error})") from error
    walk.layout.size = len(raw)
    return walk.layout


class _Walk:
    def __init__(self, raw: bytes, types: Types, cdr: bool) -> None:
        self.raw = raw
        self.types = types
        self.cdr = cdr
        self.at = 0
        self.steps = 0
        self.layout = MessageLayout()
        self.order = "<"
        if cdr:
            if raw[:2] not in (b"\0\0", b"\0\1"):
                raise DataError("a message whose encoding is not plain CDR")
            self.order = "<" if raw[1] else ">"
            self.layout.fixed.append((0, raw[:4]))
            self.at = 4

    def align(self, size: int) -> None:
        if self.cdr:
            # CDR aligns from behind its header of 4 bytes.
            self.at += -(self.at - 4) % size

    def length(self) -> int:
        self.align(4)
        (count,) = struct.unpack_from(f"{self.order}I", self.raw, self.at)
        self.layout.fixed.append((self.at, self.raw[self.at : self.at + 4]))
        self.at += 4
        # An element takes a byte at least.
        if count > len(self.raw) - self.at:
            raise DataError(f"a list of {count} in a message of {len(self.raw)} bytes")
        return int(count)

    def message(self, message_type: str, path: str, depth: int) -> None:
        if depth > _DEEPEST:
            raise DataError(f"message types nested more than {_DEEPEST} deep")
        names: list[str] = []
        for name, kind in self.types.fielddefs[message_type][1]:
            texts = self.value(kind, f"{path}.{name}" if path else name, names, depth)
            if name in ("name", "names") and texts:
                names = texts

    def value(self, kind: Any, path: str, names: list[str], depth: int) -> list[str]:
        """Return one field; returns the texts of a list of texts."""
        self.steps += 1
        if self.steps > _MAX_STEPS:
            raise LongMessageError(f"a message of more than {_MAX_STEPS:,} fields")
        what, detail = int(kind[0]), kind[1]
        if what == _BASE:
            self.base(detail[0], path)
        elif what == _NAME:
            self.message(detail, path, depth + 1)
        elif what in (_ARRAY, _SEQUENCE):
            inner, count = detail
            count = self.length() if what == _SEQUENCE else int(count)
            return self.several(inner, count, path, names, depth)
        else:
            raise DataError(f"a field of unknown kind {what}")
        return []

    def several(self, kind: Any, count: int, path: str, names: list[str], depth: int) -> list[str]:
        """Visit a list. Numbers are named by the accompanying list of names, otherwise counted from 1."""
        plain = int(kind[0]) == _BASE
        if not plain and count > _MAX_STEPS:
            raise DataError(f"a list of {count} messages in a message")
        if plain and kind[1][0] in ("string", "wstring"):
            if count > len(self.raw):
                raise DataError(f"a list of {count} texts in a message of {len(self.raw)} bytes")
            return [self.text(kind[1][0]) for _ in range(count)]
        if plain and count > LARGEST_ARRAY:
            size = int(_DTYPES[kind[1][0]][1])
            self.align(size)
            self.at += size * count
            return []
        suffixes = [f".{name}" for name in names] if len(names) == count else [f"_{i + 1}" for i in range(count)]
        for suffix in suffixes:
            self.value(kind, path + suffix, [], depth + 1)
        return []

    def text(self, kind: str) -> str:
        count = self.length()
        size = count * (2 if kind == "wstring" and self.cdr else 1)
        if self.at + size > len(self.raw):
            raise DataError(f"a text of {size} bytes in a message of {len(self.raw)}")
        text_bytes = self.raw[self.at : self.at + size]
        # The names of a list decide what its numbers are called, so they must be the same in every message.
        self.layout.fixed.append((self.at, text_bytes))
        self.at += size
        return text_bytes.decode("utf-8", errors="replace").rstrip("\0")

    def base(self, kind: str, path: str) -> None:
        if kind in ("string", "wstring"):
            self.skip_text(kind)
            return
        dtype = _DTYPES[kind]
        size = int(dtype[1])
        self.align(size)
        if self.at + size > len(self.raw):
            raise DataError(f"a message of {len(self.raw)} bytes that ends inside '{path}'")
        self.layout.fields[path] = (self.at, self.order + dtype)
        self.at += size

    def skip_text(self, kind: str) -> None:
        """Skip a text, whose content may change from message to message if its length does not."""
        before = len(self.layout.fixed)
        self.text(kind)
        # The length stays among the fixed bytes, since it decides where all later fields lie.
        del self.layout.fixed[before + 1 :]


def columns_of(
    raws: Sequence[bytes], names: Sequence[str], message_type: str, types: Types, cdr: bool
) -> list[NDArray[Any]]:
    """Return the named fields of many messages of one type, each an array of shape ``(message,)``.

    float32 where the field is, else float64; whole seconds and nanoseconds keep every digit. A message without the
    field, whose list is shorter, has NaN.

    Raises:
        DataError: a message does not fit its type.
    """
    columns: list[NDArray[Any] | None] = [None] * len(names)
    sizes = np.fromiter((len(raw) for raw in raws), dtype=np.int64, count=len(raws))
    # Messages of one length form a matrix of bytes, which is read by columns.
    for size in np.unique(sizes):
        rest = np.flatnonzero(sizes == size)
        block = np.frombuffer(b"".join([raws[i] for i in rest.tolist()]), dtype=np.uint8).reshape(len(rest), int(size))
        rows = np.arange(len(rest))
        while len(rows):
            layout = layout_of(block[rows[0]].tobytes(), message_type, types, cdr)
            same = np.ones(len(rows), dtype=np.bool_)
            for at, expected in layout.fixed:
                part = block[rows, at : at + len(expected)]
                same &= (part == np.frombuffer(expected, dtype=np.uint8)).all(axis=1)
            chosen = block if len(rows) == len(block) and same.all() else block[rows[same]]
            for name_index, name in enumerate(names):
                if name not in layout.fields:
                    continue
                at, dtype = layout.fields[name]
                wide = int(dtype[2])
                column = np.ascontiguousarray(chosen[:, at : at + wide]).view(dtype).ravel()
                column_dtype = np.dtype(np.float32 if dtype[1:] == "f4" else np.float64)
                target = columns[name_index]
                if target is None:
                    target = columns[name_index] = np.full(len(raws), np.nan, dtype=column_dtype)
                target[rest[rows[same]]] = column
            # Only the numbers of the rows left are kept: messages may all differ.
            rows = rows[~same]
    return [np.full(len(raws), np.nan) if column is None else column for column in columns]
