"""Opening a log in a sandbox: a `RawLog` whose columns are read by another process (`edp.logs.served`).

That process ends when nothing refers to the log's columns any more.
"""

from __future__ import annotations

import dataclasses
import os
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError, EdpError, StorageError, brief
from edp.logs.formats.base import FORMATS, Column, LogFormat, RawLog, RawSignal, load_column
from edp.sandbox import WorkerConnection, open_channel
from edp.sandbox.layers import are_layers_required, note_layers
from edp.sandbox.protocol import Header
from edp.sandbox.sandbox import SMALL_BYTES
from edp.signals import Kind, SignalMap
from edp.storage.memory import check_memory

WORKER = "edp.logs.sandbox_worker"
AHEAD = 2
"""Number of segments requested at a time, so that the next segment is read during processing."""
_NUMBER_BYTES = 8
"""Maximum size of a number in bytes, to predict the size of results."""
_KINDS: Mapping[str, type[EdpError]] = {kind.__name__: kind for kind in (DataError, ConfigError, StorageError)}


def read_apart(chosen: LogFormat, path: Path, size: int, signal_map: SignalMap) -> RawLog:
    """Read a log by its format in a separate process.

    Args:
        chosen: a format of `FORMATS`; where it is defined must be a module that can be imported.
        path: the log, a file or the folder of a bag.
        size: total size of its files in bytes.
        signal_map: see `edp.logs.open_log`.

    Raises:
        DataError: the file cannot be read, or not within its limits; no process can be started; or a layer of the
            sandbox is missing and all are required (`edp.sandbox.layers`).
        ConfigError: the environment variable `EDP_SANDBOX` holds an unknown word.
    """
    all_layers = are_layers_required()
    libraries = list(getattr(chosen, "libraries", ()))
    name = FORMATS.name_of(chosen)
    # The module that registered the format, which for a plug-in may be another one than that of its class.
    modules = list(dict.fromkeys([type(chosen).__module__, FORMATS.module_of(name) or type(chosen).__module__]))
    channel = open_channel(WORKER, modules, path, libraries)
    channel.size = size
    try:
        folder = os.getcwd()
    except FileNotFoundError:
        # The current folder was removed: relative paths have no meaning, absolute ones do.
        folder = os.sep
    order = {"path": str(path), "folder": folder, "size": size, "format": name}
    channel.send(order | {"map": plain_map(signal_map), "all_layers": all_layers})
    log = _Log(path, channel)
    note_layers(path, log.answer().get("layers"))
    facts = log.answer()
    try:
        return _raw_log(path, log, facts)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"'{path}' cannot be read: its facts are damaged ({type(error).__name__}: {brief(error)})"
        ) from error


def plain_map(signal_map: SignalMap) -> Header:
    """Convert a signal map to JSON types."""
    return dataclasses.asdict(signal_map)


def _raw_log(path: Path, log: _Log, facts: Header) -> RawLog:
    times: dict[int, _Time] = {}
    tables: dict[int, _Table] = {}
    signals: dict[str, RawSignal] = {}
    for signal_index, (key, entry) in enumerate(facts["signals"]):
        name, samples, unit, kind, description, time, table, column = entry
        # type() instead of isinstance, since True is an int for Python.
        if type(samples) is not int or samples < 0:
            raise ValueError(f"a column of {samples!r} values")
        served = None if table is None else tables.setdefault(table, _Table(log, int(table)))
        load = partial(log.load, signal_index) if served is None else partial(_load, path, served, str(column), samples)
        signals[str(key)] = RawSignal(
            str(name),
            load,
            samples,
            None if time is None else times.setdefault(time, _Time(log, int(time))),
            unit=None if unit is None else str(unit),
            kind=None if kind is None else Kind(kind),
            description=str(description),
            table=served,
            key=str(column),
        )
    rate, name, digest = facts["rate_hz"], facts["name"], facts["digest"]
    return RawLog(
        path,
        signals,
        scalars={str(key): float(value) for key, value in facts["scalars"].items()},
        rate_hz=None if rate is None else float(rate),
        name=None if name is None else str(name),
        source=str(facts["source"]),
        meta=dict(facts["meta"]),
        aliases={str(key): str(full) for key, full in facts["aliases"].items()},
        repeated={str(key): [full for full in among if full in signals] for key, among in facts["repeated"].items()},
        digest=None if digest is None else str(digest),
    )


def _load(path: Path, table: _Table, key: str, samples: int) -> Column:
    """Return one whole column, joined from chunks."""
    check_memory(path, 2 * _NUMBER_BYTES * samples, f"a column of {samples} values", "read it in parts, or some rows")
    return load_column(table, key, samples)


@dataclass
class _Stream:
    """Received chunks of a table, and the number of outstanding ones."""

    number: int
    rows: int
    row_bytes: int
    came: deque[Header | list[NDArray[Any]] | EdpError] = field(default_factory=deque)
    awaited: int = 0


class _Log:
    """Connection to the process that holds the log.

    Requests of several threads take turns; responses arrive in order.
    """

    def __init__(self, path: Path, channel: WorkerConnection) -> None:
        self.path = path
        self.channel = channel
        self.lock = threading.RLock()
        self.awaited: deque[_Stream] = deque()
        self.dropped: deque[int] = deque()
        self.opened = 0

    def answer(self, most: int = 0) -> Header:
        """Return the response to a request other than ``next``."""
        header, _ = self.channel.receive(most)
        _raise_refusal(header)
        return header

    def load(self, signal_index: int) -> Column:
        """Return one whole column of a log that has no tables."""
        return np.asarray(self.array({"do": "load", "of": signal_index}), dtype=np.float64)

    def array(self, request: Header) -> NDArray[Any]:
        """Return one array, whose size is weighed before it comes."""
        with self.lock:
            self._drain()
            self._send(request)
            size = int(self.answer()["bytes"])
            try:
                check_memory(self.path, size, f"a column of {size} bytes", "read it in parts, or some rows")
            except DataError:
                # Its bytes are under way already, so this connection cannot be used any more.
                self.channel.close("a column is larger than memory")
                raise
            return self.channel.receive(size)[1][0]

    def open(self, table: int, keys: Sequence[str], start: int, stop: int) -> _Stream:
        """Begin to read chunks."""
        with self.lock:
            # Both sides would wait for ever: this one to send a long request, the other one to send its answers.
            if sum(map(len, keys)) + _NUMBER_BYTES * len(keys) > SMALL_BYTES // 2:
                self._drain()
            self.opened += 1
            request = {"do": "open", "stream": self.opened, "table": table, "keys": list(keys)}
            self._send(request | {"start": int(start), "stop": int(stop)})
            return _Stream(self.opened, int(stop) - int(start), _NUMBER_BYTES * len(keys))

    def next(self, stream: _Stream) -> list[NDArray[Any]] | None:
        """Return the next chunk; None after the last one."""
        with self.lock:
            while len(stream.came) + stream.awaited < AHEAD:
                self._send({"do": "next", "stream": stream.number})
                stream.awaited += 1
                self.awaited.append(stream)
            while not stream.came:
                self._take()
        came = stream.came.popleft()
        if isinstance(came, EdpError):
            raise came
        return None if isinstance(came, dict) else came

    def drop(self, stream: _Stream) -> None:
        """Stop reading a stream.

        Nothing is sent here, where the interpreter may have come in the midst of sending: the next request says so.
        """
        stream.came.clear()
        self.dropped.append(stream.number)

    def _send(self, request: Header) -> None:
        dropped = [self.dropped.popleft() for _ in range(len(self.dropped))]
        self.channel.send(request | {"drop": dropped} if dropped else request)

    def _drain(self) -> None:
        """Receive all outstanding responses, so that the other side can accept a long request."""
        while self.awaited:
            self._take()

    def _take(self) -> None:
        stream = self.awaited.popleft()
        stream.awaited -= 1
        header, columns = self.channel.receive(stream.rows * stream.row_bytes)
        if columns:
            stream.rows -= len(columns[0])
            # What comes was made by a process that a hostile file went through.
            if stream.rows < 0 or len(columns) * _NUMBER_BYTES != stream.row_bytes or len(set(map(len, columns))) > 1:
                self.channel.close("its reading failed; open it again")
                raise DataError(f"'{self.path}' cannot be read: it gives other columns than were asked for")
            stream.came.append(columns)
            return
        try:
            _raise_refusal(header)
            stream.came.append(header)
        except EdpError as error:
            stream.came.append(error)


def _raise_refusal(header: Header) -> None:
    if "refused" in header:
        raise _KINDS.get(str(header.get("kind")), DataError)(str(header["refused"]))


class _Table:
    """A table that another process reads."""

    def __init__(self, log: _Log, number: int) -> None:
        self.log = log
        self.number = number

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`."""
        stream = self.log.open(self.number, names, start, stop)
        try:
            while (columns := self.log.next(stream)) is not None:
                yield columns
        finally:
            self.log.drop(stream)


class _Time:
    """Time stamps that another process reads; once."""

    def __init__(self, log: _Log, number: int) -> None:
        self.log = log
        self.number = number
        self.stamps: Column | None = None

    def __call__(self) -> Column:
        with self.log.lock:
            if self.stamps is None:
                self.stamps = self.log.array({"do": "time", "of": self.number})
        return self.stamps
