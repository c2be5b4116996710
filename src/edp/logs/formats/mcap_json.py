"""MCAP files with JSON messages, as written by recorders without ROS and by `edp live --record`.

A column is a number in the messages of a topic, named as in bags: ``/topic.path.of.field``, elements of lists from 1.
Nothing of a file is taken on trust: records are walked within their bounds (`mcap_check`), chunks are unpacked to the
size that they announce, messages are bounded, and JSON is data.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.formats.base import RawLog, RawSignal
from edp.logs.formats.edp_metadata import LONGEST_FACTS, EdpMetadata, parse_edp_metadata
from edp.logs.formats.mcap_check import check_records
from edp.logs.formats.names import only, told_apart
from edp.logs.formats.rosbag_write import FACTS_TOPIC
from edp.storage.memory import check_memory
from edp.storage.reading import parse_json
from edp.storage.unpacking import unpack_to

MAGIC_BYTES = 8
ROS = ("ros1", "ros2")
"""Profiles whose messages are read by `rosbag`."""
JSON = "json"
LONGEST_MESSAGE = 1 << 18
"""Maximum size of a message in bytes. A row of a thousand channels takes about 40,000."""
MAX_PATHS, MAX_TOPICS = 4096, 1024
"""Maximum number of values per message of a topic, and maximum number of topics in a file."""
LONGEST_TOPIC = 1024
CHECKED = 1 << 24
"""Number of values between two checks of the remaining memory."""
LONGEST_LIST = 256
"""Maximum length of a list that becomes columns. Longer lists are images or point clouds."""
_HEADER, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x01, 0x04, 0x05, 0x06, 0x0F
_PREFIX = struct.Struct("<BQ")
_HEAD = struct.Struct("<HIQQ")
"""Head of a message: channel, sequence, log time, publishing time."""


@dataclass
class _Topic:
    """Messages of one channel."""

    name: str
    encoding: str
    at_ns: array[int] = field(default_factory=lambda: array("q"))
    columns: dict[str, array[float]] = field(default_factory=dict)
    facts: str = ""

    def take(self, at_ns: int, values: dict[str, float], where: str) -> None:
        """Add the values of a message; missing values become NaN, also for earlier messages without the column."""
        rows = len(self.at_ns)
        for name, value in values.items():
            column = self.columns.get(name)
            if column is None:
                if len(self.columns) >= MAX_PATHS:
                    raise DataError(f"{where}: topic '{self.name}' holds more than {MAX_PATHS} numbers")
                column = self.columns[name] = array("d", [math.nan]) * rows
            column.append(value)
        self.at_ns.append(at_ns)
        if len(values) < len(self.columns):
            for column in self.columns.values():
                if len(column) == rows:
                    column.append(math.nan)


def holds_json(path: Path) -> bool:
    """Return whether an MCAP file has JSON messages: its profile is not a ROS profile.

    Raises:
        DataError: the file is cut off within its header.
    """
    with path.open("rb") as stream:
        head = stream.read(MAGIC_BYTES + _PREFIX.size + 4 + 64)
    if len(head) < MAGIC_BYTES + _PREFIX.size + 4 or head[MAGIC_BYTES] != _HEADER:
        return False
    (length,) = struct.unpack_from("<I", head, MAGIC_BYTES + _PREFIX.size)
    start = MAGIC_BYTES + _PREFIX.size + 4
    return head[start : start + min(length, 64)].decode("utf-8", "replace") not in ROS


def read_json_mcap(path: Path) -> RawLog:
    """Return all columns of a file.

    Raises:
        DataError: it is damaged, beyond its bounds, or holds no numbers in JSON.
    """
    check_records(path)
    try:
        topics = _topics(path)
    except (struct.error, UnicodeDecodeError, EOFError, ValueError, IndexError) as error:
        raise DataError(f"'{path}' is a damaged MCAP file: {str(error)[:200]}; copy or record it again") from error
    filled = [topic for topic in topics if topic.columns]
    if not filled:
        encodings = ", ".join(sorted({topic.encoding for topic in topics})) or "none"
        raise DataError(
            f"'{path}' holds no numbers in messages that are read: JSON, or those of ROS 2 (encodings: {encodings}); "
            "convert the wanted topics to CSV or Parquet"
        )
    about = next((topic.facts for topic in topics if topic.name == FACTS_TOPIC and topic.facts), "")
    facts = parse_edp_metadata(about, f"'{path}', topic '{FACTS_TOPIC}'") if about else EdpMetadata()
    origin = min(topic.at_ns[0] for topic in filled)
    named_signals = [pair for topic in filled for pair in _signals(topic, facts, origin)]
    signals, aliases, repeated = told_apart(named_signals)
    if facts.channels:
        signals, repeated = only(facts.channels, signals, repeated)
    return RawLog(path, signals, aliases=aliases, repeated=repeated, **facts.to_log_metadata())


def _signals(topic: _Topic, facts: EdpMetadata, origin: int) -> Iterator[tuple[str, RawSignal]]:
    at_ns: NDArray[np.int64] = np.asarray(topic.at_ns, dtype=np.int64) - origin
    seconds = (at_ns * 1e-9).astype(np.float64)
    for name, values in topic.columns.items():
        channel = facts.channels.get(name)
        signal = RawSignal(
            name,
            partial(np.asarray, values, np.float64),
            len(values),
            None if facts.rate_hz else seconds,
            unit=channel.unit if channel else None,
            kind=channel.kind if channel else None,
            description=channel.description if channel else "",
        )
        yield f"{topic.name}.{name}", signal


def _topics(path: Path) -> Sequence[_Topic]:
    """Return every channel with its messages, in one go through the file."""
    by_number: dict[int, _Topic] = {}
    values = 0
    check_memory(path, path.stat().st_size, "its messages", "record shorter files")
    for kind, body in _records(path, memoryview(path.read_bytes())):
        if kind == _CHANNEL:
            number, topic = _channel(body)
            if len(by_number) >= MAX_TOPICS:
                raise ValueError(f"it has more than {MAX_TOPICS} channels")
            by_number.setdefault(number, topic)
        elif kind == _MESSAGE:
            values += _message(path, body, by_number)
            if values >= CHECKED:
                # What is there already is taken; the next as many must fit, too.
                check_memory(path, 8 * values, "its messages", "record shorter files")
                values = 0
    return list(by_number.values())


def _message(path: Path, body: memoryview, by_number: dict[int, _Topic]) -> int:
    """Take a message; how many values it brought."""
    number, _, at_ns, _ = _HEAD.unpack_from(body)
    topic = by_number.get(number)
    if topic is None:
        raise ValueError(f"a message of channel {number}, which nothing describes")
    if topic.encoding != JSON:
        return 0
    content = body[_HEAD.size :]
    is_facts = topic.name == FACTS_TOPIC
    if len(content) > (LONGEST_FACTS if is_facts else LONGEST_MESSAGE) or at_ns >= 1 << 63:
        raise ValueError(f"a message of {len(content)} bytes at {at_ns} ns on '{topic.name[:80]}'")
    text = bytes(content).decode()
    if is_facts:
        topic.facts = topic.facts or text
        return 0
    where = f"'{path}', a message of '{topic.name[:80]}'"
    values: dict[str, float] = {}
    _flatten("", parse_json(text, where, DataError), values, where)
    if not values:
        return 0
    topic.take(at_ns, values, where)
    return len(values)


def _flatten(name: str, value: Any, values: dict[str, float], where: str) -> None:
    """Collect the values in a value by their paths; null is a missing number. The parser limits the depth."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(f"{name}.{key}" if name else key, inner, values, where)
    elif isinstance(value, list):
        for at, inner in enumerate(value[:LONGEST_LIST]):
            _flatten(f"{name}_{at + 1}", inner, values, where)
    elif value is None or isinstance(value, int | float):
        if len(values) >= MAX_PATHS:
            raise DataError(f"{where} holds more than {MAX_PATHS} numbers")
        values[name or "data"] = math.nan if value is None else float(value)


def _records(path: Path, view: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Return the channels and messages up to the end of the data, those within chunks included."""
    for kind, body in _walk(view[MAGIC_BYTES:]):
        if kind == _DATA_END:
            return
        if kind == _CHUNK:
            yield from _walk(memoryview(_unpack_chunk(path, body)))
        else:
            yield kind, body


def _walk(view: memoryview) -> Iterator[tuple[int, memoryview]]:
    at = 0
    while at + _PREFIX.size <= len(view):
        kind, length = _PREFIX.unpack_from(view, at)
        at += _PREFIX.size
        if length > len(view) - at:
            raise ValueError(f"a record of {length} bytes that is cut off")
        yield kind, view[at : at + length]
        at += length


def _unpack_chunk(path: Path, body: memoryview) -> bytes | memoryview:
    """Return the records of a chunk, at most as many bytes as it announces (`mcap_check` has checked the size)."""
    size, _, named = struct.unpack_from("<QII", body, 16)
    packing = bytes(body[32 : 32 + named]).decode()
    packed = body[40 + named :]
    if not packing:
        return packed
    if packing not in ("lz4", "zstd"):
        raise ValueError(f"a chunk packed by {packing[:20]!r}; lz4 and zstd are read")
    try:
        unpacked_bytes = unpack_to(packing, packed, size)
    except Exception as error:
        raise DataError(
            f"'{path}': a chunk cannot be unpacked ({str(error)[:200]}); copy or record it again"
        ) from error
    if len(unpacked_bytes) != size:
        raise ValueError(f"a chunk of {size} bytes that unpacks to another size")
    return unpacked_bytes


def _channel(body: memoryview) -> tuple[int, _Topic]:
    number, _, length = struct.unpack_from("<HHI", body)
    topic = bytes(body[8 : 8 + min(length, LONGEST_TOPIC + 1)]).decode()
    if len(topic) > LONGEST_TOPIC:
        raise ValueError(f"a topic with a name of {length} bytes")
    (encoded,) = struct.unpack_from("<I", body, 8 + length)
    encoding = bytes(body[12 + length : 12 + length + min(encoded, 64)]).decode()
    return number, _Topic(topic, encoding)
