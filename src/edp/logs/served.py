"""Server side in the sandbox: one log is read by its format, and its columns are sent on request.

The messages are those of `edp.sandbox.protocol`. After the order come the layers of the sandbox (for each one why it
is missing, empty where it holds), the log's data, then answers to requests:
``time`` and ``load`` (a header with the number of bytes, then the array), ``open`` and ``next`` for the segments of a
table, and with any of them the segments that nobody wants any more (``drop``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, EdpError, brief
from edp.logs.formats.base import FORMATS, Column, ColumnTable, LogFormat, RawLog, RawSignal
from edp.sandbox import lock_down
from edp.sandbox.allowance import Allowance, is_exhausted
from edp.sandbox.protocol import Header, is_plain, reader, receive, send, writer
from edp.signals import ChannelMap, Kind, SignalMap
from edp.storage.memory import announce

MESSAGE_BYTES = 1 << 24
"""Maximum size of the numbers in one message. Larger parts are divided."""
BAGS = ("mcap", "rosbag1", "rosbag2")
"""Formats whose library needs the suffix of the path."""
_TEXT = 4000
"""Maximum length of an error message. Its end is kept, because it states the remedy."""
_END = 500
_STAMP_BYTES = 128
"""Memory for a time stamp while it is collected message by message."""
_KEPT_BYTES = 24
"""Memory for a selected value in formats that store whole columns, up to `_KEPT_MOST`."""
_KEPT_MOST = 3 << 29


def map_of(plain: Header) -> SignalMap:
    """Return the signal map of an order; see `edp.logs.sandboxed.plain_map`."""
    entries = [entry | {"kind": Kind(entry["kind"]) if entry["kind"] else None} for entry in plain["channels"]]
    channels = tuple(ChannelMap(**entry) for entry in entries)
    return SignalMap(**plain | {"channels": channels, "columns": tuple(plain["columns"])})


def serve(requests: int, answers: int) -> None:
    """Receive an order, read its log, and respond to requests until the client closes."""
    read_into, write = reader(requests), writer(answers)
    with contextlib.suppress(EOFError, BrokenPipeError):
        order, _ = receive(read_into)
        os.chdir(order["folder"])
        path = Path(order["path"])
        # Limits and lock-down both hold before the file is opened.
        allowance = Allowance(path, order["size"])
        keep_temporary_files_in_memory()
        layers = lock_down([Path(os.path.realpath(path))])
        # Before the log is opened: a hostile one cannot speak for the layers.
        send(write, {"layers": layers})
        if order["all_layers"] and any(layers.values()):
            return
        served = _answer(write, allowance, 0, lambda: _read(order, path))
        while served is not None:
            request, _ = receive(read_into)
            served.obey(request, write, allowance)


def _read(order: Header, path: Path) -> tuple[Header, _Served]:
    chosen, signal_map = FORMATS[order["format"]], map_of(order["map"])
    try:
        str(path).encode()
    except UnicodeEncodeError:
        served = _Served(_read_oddly_named(chosen, path, signal_map))
    else:
        served = _Served(chosen.read(path, signal_map))
    return served.facts(), served


def _read_oddly_named(chosen: LogFormat, path: Path, signal_map: SignalMap) -> RawLog:
    """Return a name in UTF-8 for libraries that accept only UTF-8.

    The link of an open file has such a name, but no suffix, which bags need.
    """
    if chosen.name in BAGS:
        raise DataError(f"'{path}' cannot be read: the name of a bag must be UTF-8; rename it")
    link = Path(f"/proc/self/fd/{os.open(path, os.O_RDONLY)}")
    try:
        return chosen.read(link, signal_map)
    except EdpError as error:
        raise type(error)(str(error).replace(str(link), str(path))) from error


def _answer(
    write: Callable[[Any], None], allowance: Allowance, values: int, work: Callable[[], tuple[Header, Any]]
) -> Any:
    """Do work within the limits and send its header; return the result, None on failure."""
    try:
        with allowance.running(allowance.seconds(values)):
            header, result = work()
        send(write, header)
    except (EOFError, BrokenPipeError):
        raise
    except Exception as error:
        send(write, refusal(error, allowance))
        return None
    return result


def refusal(error: Exception, allowance: Allowance) -> Header:
    """Return the error message about the file for the client.

    Libraries meet damaged bytes with any exception there is; every one means the same to the user.
    """
    if is_exhausted(error):
        error = allowance.exhausted()
    if isinstance(error, EdpError):
        message = str(error)
        message = message if len(message) <= _TEXT else f"{message[: _TEXT - _END - 5]} ... {message[-_END:]}"
        return {"refused": message, "kind": type(error).__name__}
    message = f"{type(error).__name__}: {brief(error)}"
    advice = "it may be truncated or damaged: copy or export it again"
    return {"refused": f"'{allowance.path}' cannot be read ({message}); {advice}", "kind": DataError.__name__}


@dataclass
class _Stream:
    """Pieces of a table that are being read, in parts that a message takes, and the processor time left for it."""

    parts: Iterator[list[NDArray[Any]]]
    seconds: float


@dataclass
class _Served:
    """The log that was read."""

    raw: RawLog
    times: list[Column | Callable[[], Column]] = field(default_factory=list)
    tables: list[ColumnTable] = field(default_factory=list)
    streams: dict[int, _Stream] = field(default_factory=dict)

    def facts(self) -> Header:
        """Return the description of the log without its values."""
        raw = self.raw
        times: dict[Any, int] = {}
        tables: dict[int, int] = {}
        signals = []
        for signal in raw.signals.values():
            time = table = None
            if signal.time is not None:
                key = signal.time if callable(signal.time) else id(signal.time)
                time = times.setdefault(key, len(times))
                if time == len(self.times):
                    self.times.append(signal.time)
            if signal.table is not None:
                table = tables.setdefault(id(signal.table), len(tables))
                if table == len(self.tables):
                    self.tables.append(signal.table)
            kind = None if signal.kind is None else str(signal.kind)
            signals.append(
                [signal.name, signal.samples, signal.unit, kind, signal.description, time, table, signal.key]
            )
        plain = {item.name: getattr(raw, item.name) for item in dataclasses.fields(raw)}
        del plain["path"]
        named = {name: list(full) for name, full in raw.repeated.items()}
        return plain | {"signals": list(zip(raw.signals, signals)), "repeated": named}

    def obey(self, request: Header, write: Callable[[Any], None], allowance: Allowance) -> None:
        """Answer one request."""
        doing = request["do"]
        for number in request.get("drop", ()):
            self.streams.pop(number, None)
        if doing == "time":
            signal = next(s for s in self.raw.signals.values() if s.time is not None and self._time(s) == request["of"])
            announce(memory=_STAMP_BYTES * signal.samples)
            self._array(write, allowance, signal.samples, lambda: signal.time_s)
        elif doing == "load":
            signal = list(self.raw.signals.values())[request["of"]]
            self._array(write, allowance, signal.samples, signal.load)
        elif doing == "open":
            keys, start, stop = request["keys"], request["start"], request["stop"]
            values = (stop - start) * len(keys)
            announce(memory=min(_KEPT_BYTES * values, _KEPT_MOST) + _STAMP_BYTES * (stop - start))
            parts = _parts(self.tables[request["table"]], keys, start, stop)
            self.streams[request["stream"]] = _Stream(parts, allowance.seconds(values))
        else:
            self._next(request["stream"], write, allowance)

    def _time(self, signal: RawSignal) -> int:
        same = (
            time_index for time_index, time in enumerate(self.times) if time is signal.time or _equal(time, signal.time)
        )
        return next(same)

    def _array(
        self,
        write: Callable[[Any], None],
        allowance: Allowance,
        values: int,
        load: Callable[[], Column | None],
    ) -> None:
        def work() -> tuple[Header, list[NDArray[Any]]]:
            array = np.asarray(load())
            check_plain(self.raw.path, [array])
            return {"bytes": array.nbytes}, [array]

        result = _answer(write, allowance, values, work)
        if result is not None:
            send(write, {}, result)

    def _next(self, number: int, write: Callable[[Any], None], allowance: Allowance) -> None:
        stream = self.streams.get(number)
        # Dropped by the other side while its request was under way.
        if stream is None:
            send(write, {"end": True})
            return
        try:
            with allowance.running(stream.seconds) as left:
                columns = next(stream.parts, None)
                if columns is not None:
                    check_plain(self.raw.path, columns)
            # The limit holds for the whole stream: a table in many pieces gets no new time for each.
            stream.seconds = left[0]
        except Exception as error:
            del self.streams[number]
            send(write, refusal(error, allowance))
            return
        if columns is None:
            del self.streams[number]
            send(write, {"end": True})
        else:
            send(write, {}, columns)


def _equal(time: Any, other: Any) -> bool:
    return callable(time) and callable(other) and bool(time == other)


def check_plain(path: Path, arrays: Sequence[NDArray[Any]]) -> None:
    """Refuse columns that are not numeric or have unequal lengths.

    Raises:
        DataError: naming the file.
    """
    if not all(map(is_plain, arrays)) or len({len(array) for array in arrays}) > 1:
        raise DataError(f"'{path}' holds a column of no plain numbers; map another")


def _parts(table: ColumnTable, keys: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
    """Return the segments, cut where a message would be too long."""
    for columns in table.pieces(keys, start, stop):
        row = sum(column.itemsize for column in columns)
        rows = max(MESSAGE_BYTES // max(row, 1), 1)
        for start in range(0, len(columns[0]) if columns else 0, rows):
            yield [column[start : start + rows] for column in columns]


def keep_temporary_files_in_memory() -> None:
    """Make the MDF library use memory in place of the temporary file that it opens for appended data."""
    for name in ("asammdf.blocks.mdf_v4", "asammdf.blocks.mdf_v3"):
        if name in sys.modules:
            vars(sys.modules[name])["NamedTemporaryFile"] = lambda *_, **__: io.BytesIO()
