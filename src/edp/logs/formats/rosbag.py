"""Bags of ROS 1 and ROS 2 and MCAP files, read through rosbags without an installed ROS.

A column is a number in the messages of a topic. Its full name is ``/topic.path.of.field``; elements of a list count
from 1 (``/cylinders.data_1``) or go by the names beside them (``/joint_states.velocity.boom``). Its short name is the
path, or the topic's last part where the topic holds nothing but ``data``.
"""

from __future__ import annotations

import struct
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, brief
from edp.logs.formats.bag_guard import check_counts, definitions_of, open_reader
from edp.logs.formats.base import FORMATS, PIECE_ROWS, Column, RawLog, RawSignal, WriteOptions, load_column
from edp.logs.formats.edp_metadata import EdpMetadata, parse_edp_metadata
from edp.logs.formats.mcap_json import holds_json, read_json_mcap
from edp.logs.formats.names import only, told_apart
from edp.logs.formats.ros_message import LongMessageError, columns_of, layout_of
from edp.logs.formats.rosbag_write import FACTS_TOPIC, write_bag
from edp.recording import Recording
from edp.signals import VOCABULARY, SignalMap
from edp.storage.paths import is_file_at, is_folder_at

KEPT_BYTES = 1 << 29
"""Maximum size of columns read in one pass through the file. Larger selections are read per topic in segments."""
_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
"""Field names of both parts of a header's time, as the library uses them for ROS 1 and ROS 2."""
_LOG_TIME, _HEADER_TIME = "log_time", "header.stamp"


class BagFormat:
    """One container of messages."""

    libraries = ("rosbags.rosbag1", "rosbags.rosbag2", "rosbags.typesys")

    def __init__(self, name: str, suffix: str, content: str, magic: bytes) -> None:
        self.name = name
        self.suffixes: tuple[str, ...] = (suffix,)
        self.content = content
        self.magic = magic

    def claims(self, head: bytes) -> bool:
        """Return whether the file starts with the container's magic number."""
        return head.startswith(self.magic)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read topics, types and the first message of each topic; other messages are read on demand."""
        if self.name == "mcap" and is_file_at(path) and holds_json(path):
            return read_json_mcap(path)
        column_names = {entry.column for entry in signal_map.channels} or set(VOCABULARY)
        bag = _Bag(path, column_names, signal_map)
        edp_metadata = bag.facts()
        named_signals = [signal for topic in bag.topics for signal in topic.signals(edp_metadata)]
        if not named_signals:
            topic_names = ", ".join(sorted(bag.about)) or "none"
            if lists := [f"{topic.name} ({topic.kind})" for topic in bag.topics if topic.long]:
                raise DataError(
                    f"'{path}' holds no signals: each message of {', '.join(lists)} is a list of many numbers, such as "
                    "a plan or a cloud, not a sample in time; record topics of sensors (for example /joint_states)"
                )
            raise DataError(
                f"'{path}' holds no numbers in messages (topics: {topic_names}); record topics that hold some"
            )
        signals, aliases, repeated = told_apart(named_signals)
        bag.column_names = {aliases.get(name, name) for name in column_names}
        if edp_metadata.channels:
            signals, repeated = only(edp_metadata.channels, signals, repeated)
        return RawLog(path, signals, aliases=aliases, repeated=repeated, **edp_metadata.to_log_metadata())

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write one topic with one float32 message per sample, and EDP's metadata as a text topic."""
        write_bag(recording, path, self.name)


FORMATS.register("mcap")(BagFormat("mcap", ".mcap", "MCAP", b"\x89MCAP0\r\n"))
FORMATS.register("rosbag2")(BagFormat("rosbag2", ".db3", "an SQLite database", b"SQLite format 3\0"))
FORMATS.register("rosbag1")(BagFormat("rosbag1", ".bag", "a ROS 1 bag", b"#ROSBAG V"))


class _Bag:
    """An open file or folder."""

    def __init__(self, path: Path, column_names: set[str], signal_map: SignalMap) -> None:
        if signal_map.time not in (None, _LOG_TIME, _HEADER_TIME):
            raise DataError(
                f"'{path}' has no time column '{signal_map.time}'; in a bag 'time' of the signal map is "
                f"'{_HEADER_TIME}' or '{_LOG_TIME}'"
            )
        self.path = path
        self.column_names = column_names
        self.time = signal_map.time
        with damage(path):
            self.reader = open_reader(path)
            self.cdr = not hasattr(self.reader, "chunk_infos")
            self.reader.open()
            weakref.finalize(self, _close, self.reader)
            by_topic: dict[str, list[Any]] = {}
            for connection in self.reader.connections:
                if not isinstance(connection.topic, str):
                    raise DataError("a topic without a name")
                by_topic.setdefault(connection.topic, []).append(connection)
            self.about = {name: sum(each.msgcount for each in group) for name, group in by_topic.items()}
            check_counts(path, self.about, sorted(path.iterdir()) if is_folder_at(path) else [path])
            filled = {name: group for name, group in by_topic.items() if self.about[name]}
            self.topics = [_Topic(self, name, group) for name, group in filled.items() if name != FACTS_TOPIC]
            self.facts_from = filled.get(FACTS_TOPIC)
            self.origin_ns = int(self.reader.start_time)

    def facts(self) -> EdpMetadata:
        if not self.facts_from:
            return EdpMetadata()
        with damage(self.path):
            raw = next(iter(self.reader.messages(connections=self.facts_from)))[2]
            start = 8 if self.cdr else 4
            (count,) = struct.unpack_from("<I", raw, start - 4)  # a slice ends where the message does
            text = bytes(raw[start : start + count]).rstrip(b"\0").decode()
        return parse_edp_metadata(text, f"'{self.path}', topic '{FACTS_TOPIC}'")

    @cached_property
    def together(self) -> None:
        """Read the wanted topics in one go; done at most once."""
        chosen = [topic for topic in self.topics if topic.list_wanted_paths()]
        values = sum(topic.samples * len(topic.list_wanted_paths()) for topic in chosen)
        keep = 8 * values <= KEPT_BYTES
        self.scan(chosen, keep)

    def scan(self, topics: Sequence[_Topic], keep: bool) -> None:
        """Read the stamps of some topics, and with `keep` their selected columns."""
        by_name = {topic.name: topic for topic in topics}
        paths = {topic.name: [*topic.stamp_paths, *(topic.list_wanted_paths() if keep else [])] for topic in topics}
        collected = {name: _Collected(by_name[name], paths[name]) for name in by_name}
        with damage(self.path):
            for connection, log_ns, raw in self.reader.messages([c for topic in topics for c in topic.connections]):
                collected[connection.topic].add(log_ns, raw)
            for name, topic in by_name.items():
                topic.take(*collected[name].columns(), paths[name])


class _Collected:
    """Messages of one topic, turned into columns some thousand at a time."""

    def __init__(self, topic: _Topic, paths: list[str]) -> None:
        self.topic = topic
        self.paths = paths
        self.log_ns: list[int] = []
        self.raws: list[bytes] = []
        self.done: list[list[NDArray[Any]]] = []

    def add(self, log_ns: int, raw: bytes) -> None:
        self.log_ns.append(log_ns)
        if self.paths:
            self.raws.append(raw)
            # Flush after an eighth of the usual rows, since a message contains many values.
            if len(self.raws) >= PIECE_ROWS // 8:
                self.flush()

    def flush(self) -> None:
        if self.raws:
            self.done.append(self.topic.columns(self.raws, self.paths))
            self.raws = []

    def columns(self) -> tuple[NDArray[np.int64], list[NDArray[Any]]]:
        self.flush()
        joined = [np.concatenate(parts) for parts in zip(*self.done)] if self.done else []
        return np.asarray(self.log_ns, dtype=np.int64), joined


class _Topic:
    """Messages of one topic as a table of values."""

    def __init__(self, bag: _Bag, name: str, connections: list[Any]) -> None:
        self.bag = bag
        self.name = name
        self.connections = connections
        self.samples = bag.about[name]
        self.kind = connections[0].msgtype
        self.types: Any = definitions_of(connections[0].msgdef, self.kind)
        self.kept: dict[str, NDArray[Any]] = {}
        self._stamps: Column | None = None
        self.paths: dict[str, str] = {}
        self.stamp_paths: list[str] = []
        self.long = False
        if self.types is None:
            return
        first = next(iter(bag.reader.messages(connections=connections)), None)
        if first is None:
            raise DataError(f"no message of topic '{name}', of which {self.samples} are announced")
        try:
            fields = layout_of(first[2], self.kind, self.types, bag.cdr).fields
        except LongMessageError:
            # Beside topics of signals it is passed over, as pictures are.
            self.long = True
            return
        self.stamp_paths = [path for path in _STAMP if path in fields and bag.time != _LOG_TIME]
        # Headers are time, and layouts describe how an array is to be read: neither is a signal.
        numbers = [path for path in fields if not path.startswith(("header.", "layout."))]
        for path in numbers:
            parent, _, last = path.rpartition(".")
            plain = not parent and (last == "data" or last.startswith("data_"))
            self.paths[path] = name.rpartition("/")[2] + last.removeprefix("data") if plain else path

    def signals(self, edp_metadata: EdpMetadata) -> list[tuple[str, RawSignal]]:
        named_signals = []
        for path, short in self.paths.items():
            channel_facts = edp_metadata.channels.get(short)
            signal = RawSignal(
                short,
                partial(load_column, self, path, self.samples),
                self.samples,
                None if edp_metadata.rate_hz else self.stamps,
                unit=channel_facts.unit if channel_facts else None,
                kind=channel_facts.kind if channel_facts else None,
                description=channel_facts.description if channel_facts else "",
                table=self,
                key=path,
            )
            named_signals.append((f"{self.name}.{path}", signal))
        return named_signals

    def list_wanted_paths(self) -> list[str]:
        column_names = self.bag.column_names
        return [
            path for path, short in self.paths.items() if short in column_names or f"{self.name}.{path}" in column_names
        ]

    def columns(self, raws: list[bytes], paths: Sequence[str]) -> list[NDArray[Any]]:
        return columns_of(raws, paths, self.kind, self.types, self.bag.cdr)

    def stamps(self) -> Column:
        """Return the seconds since the first message of the bag, by the message headers if they state time.

        Or by the log.
        """
        if self._stamps is None and self.list_wanted_paths():
            _ = self.bag.together
        if self._stamps is None:
            self.bag.scan([self], keep=False)
        if self._stamps is None:
            raise DataError(f"'{self.bag.path}': topic '{self.name}' has no time stamps")
        return self._stamps

    def take(self, log_ns: NDArray[np.int64], columns: list[NDArray[Any]], paths: list[str]) -> None:
        """Store the result of a scan."""
        self.check_count(len(log_ns))
        seconds = np.zeros(0)
        if len(self.stamp_paths) == 2:
            seconds, nanoseconds = columns[0], columns[1]
        # A header that nobody filled states zero.
        if seconds.any():
            # Integers: float64 has no digit left for nanoseconds since 1970.
            at_ns = seconds.astype(np.int64) * 1_000_000_000 + nanoseconds.astype(np.int64)
        elif self.bag.time == _HEADER_TIME:
            raise DataError(
                f"'{self.bag.path}': messages of '{self.name}' state no time in their header; set time = '{_LOG_TIME}' "
                "in the signal map"
            )
        else:
            at_ns = log_ns
        self._stamps = np.asarray((at_ns - self.bag.origin_ns) * 1e-9, dtype=np.float64)
        self.kept = dict(zip(paths, columns))

    def check_count(self, count: int) -> None:
        if count != self.samples:
            raise DataError(
                f"'{self.bag.path}': topic '{self.name}' announces {self.samples} messages and holds {count}; the file "
                "is truncated or damaged: copy it again or rebuild its index"
            )

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`."""
        if self._stamps is None and set(names) <= set(self.list_wanted_paths()):
            _ = self.bag.together
        if all(name in self.kept for name in names):
            yield [self.kept[name][start:stop] for name in names]
            return
        raws: list[bytes] = []
        row = 0
        with damage(self.bag.path):
            for _, _, raw in self.bag.reader.messages(connections=self.connections):
                row += 1
                if start < row <= stop:
                    raws.append(raw)
                    if len(raws) >= PIECE_ROWS // 8:
                        yield self.columns(raws, names)
                        raws = []
            self.check_count(row)
            if raws:
                yield self.columns(raws, names)


def _close(reader: Any) -> None:
    reader.close()


@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Convert any exception of the library on damaged bytes into one DataError."""
    try:
        yield
    except ImportError as error:
        raise DataError(
            f"'{path}': bags and MCAP files need the package rosbags, which is not installed; run pip install "
            "'excavator-dynamics-predictor[ros]', or convert the wanted topics to CSV or Parquet"
        ) from error
    except DataError as error:
        if str(path) in str(error):
            raise
        raise DataError(f"'{path}' holds {brief(error)}; it may be damaged: copy or record it again") from error
    except MemoryError as error:
        raise DataError(
            f"'{path}' announces more data than this machine has memory for; it may be damaged: copy or record it again"
        ) from error
    except Exception as error:
        text = str(error) or type(error).__name__
        raise DataError(f"'{path}' cannot be read: {brief(text)}{_advice(text)}") from error


def _advice(text: str) -> str:
    advice_by_symptom = {
        "Profile is not": " (only ROS 2 messages in MCAP are read, or JSON); convert topics to CSV or Parquet",
        "encryption": "; decrypt the bag first",
        "not indexed": " (its recorder was killed): run 'rosbag reindex' or record it again",
        "encrypted": "; it may be password-protected",
    }
    matching_advice = [advice for part, advice in advice_by_symptom.items() if part in text]
    return matching_advice[0] if matching_advice else "; it may be truncated or damaged: copy or record it again"
