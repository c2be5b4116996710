"""``--udp``: rows as JSON datagrams, one a tick: ``{"t": 12.34, "CylVels_1": 0.12, ...}``."""

from __future__ import annotations

import math
import select
import socket
import statistics
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from edp.errors import ConfigError, DataError
from edp.settings.bounds import shown
from edp.signals import VOCABULARY, Channel, Kind, SignalMap, conversion
from edp.storage.reading import parse_json
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Row, Sink, SourceOptions, chosen_rate

LOOPBACK = "127.0.0.1"
MOST_BYTES = 16_384
"""Of a datagram: 400 channels; a network's own limit is 65,507."""
MOST_CHANNELS = 256
BUFFER_BYTES = 1 << 20
"""That the system keeps while the models are busy: some seconds of rows."""
SILENT_S = 0.5
"""Without a row, after which the source counts as silent."""
WINDOW = 100
"""Steps between rows whose median is the rate."""
OFF_RATE = 0.05
"""Share by which the rate may differ from the models' before they predict nothing."""
POLL_S = 0.1
STARTUP_S = 30.0
"""To wait for the first row, which says what channels there are, where no model says it."""
TIME = "t"


class RowClock:
    """Whether rows come at the rate that models were trained at, how many are missing, and when time went back.

    Args:
        rate_hz: that is expected.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz, self.trusted = rate_hz, True
        self._last: float | None = None
        self._steps: deque[float] = deque(maxlen=WINDOW)

    @property
    def measured_hz(self) -> float | None:
        """Rate of the last rows, None where there are too few."""
        if len(self._steps) < WINDOW // 2:
            return None
        middle = statistics.median(self._steps)
        return 1.0 / middle if middle > 0.0 else None

    def tick(self, seconds: float) -> tuple[int, bool]:
        """Take the time of a row: ticks that are missing before it, and whether time went back."""
        step = None if self._last is None else seconds - self._last
        self._last = seconds
        if step is None:
            return 0, False
        if step < 0.0:
            self._steps.clear()
            return 0, True
        missed = max(0, round(step * self.rate_hz) - 1)
        # A gap is no rate.
        if step <= SILENT_S:
            self._steps.append(step)
        rate = self.measured_hz
        if rate is not None:
            self.trusted = abs(rate - self.rate_hz) <= OFF_RATE * self.rate_hz
        # At another rate every step would count as a gap.
        return (missed if self.trusted else 0), False


@SOURCES.register("udp")
class UdpSource(LiveSource):
    """Datagrams on a port; each is one row, and says its names.

    Args:
        port: to listen on.
        rate_hz: of the rows.
        channels: that are taken; None takes those of the first row.
        signal_map: columns and units to channels; None takes names as channels in SI units.
        host: address to listen on.

    Raises:
        ConfigError: the port is no port, or in use.
    """

    steered: ClassVar[bool] = False
    ending = "the source was closed"

    def __init__(
        self,
        port: int,
        rate_hz: float,
        channels: tuple[Channel, ...] | None = None,
        signal_map: SignalMap | None = None,
        host: str = LOOPBACK,
    ) -> None:
        self.rate_hz = rate_hz
        self._convert = _conversions(signal_map)
        self._odd = 0
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ConfigError(
                f"--udp {port}: cannot listen on {host}: {error}; choose another port, or end what holds this one"
            ) from error
        self._socket.settimeout(POLL_S)
        self.port = self._socket.getsockname()[1]
        self.text = f"UDP, port {self.port} of {host}"
        self.channels = channels or self._first_channels()

    @classmethod
    def of(cls, options: SourceOptions, needs: Needs) -> UdpSource:
        """`SourceOptions.value` is the port; the setting ``bind`` another address than loopback."""
        rate, signal_map = chosen_rate(options, needs, "--udp"), options.signal_map()
        mapped = tuple(entry.channel() for entry in signal_map.channels) if signal_map else ()
        names = {channel.name for channel in mapped}
        channels = (*mapped, *(channel for channel in needs.channels if channel.name not in names))
        host = options.settings.get("bind") or LOOPBACK
        source = cls(int(options.value), rate, channels or None, signal_map, host)
        source.machine = options.machine
        return source

    def run(self, sink: Sink) -> None:
        """See `LiveSource`; a row that is none is left out, counted and told."""
        clock, heard, silent, trusted = RowClock(self.rate_hz), time.monotonic(), False, True
        while not sink.stopped:
            message = self._received(sink)
            if message is None:
                sink.show()
                if not silent and time.monotonic() - heard > SILENT_S:
                    silent = True
                    sink.note(
                        "warning", f"no row for {SILENT_S:g} s: nothing is predicted until rows come again", "silent"
                    )
                continue
            now = time.monotonic()
            if silent:
                sink.note("note", f"rows come again, after {now - heard:.1f} s", "again")
            heard, silent = now, False
            missed, back = clock.tick(message.get(TIME, now))
            if back:
                sink.note("warning", "time went back: what follows is taken for a new session", "back")
                sink.begin_anew()
            if clock.trusted != trusted:
                trusted = clock.trusted
                self._tell_rate(sink, clock)
            sink.take(self._row(message), missed, trusted, self._waits())

    def close(self) -> None:
        """See `LiveSource`."""
        self._socket.close()

    def _waits(self) -> bool:
        """Whether a further datagram is there already: the models have been slower than the sender."""
        try:
            return bool(select.select([self._socket], [], [], 0.0)[0])
        except (OSError, ValueError):  # closed meanwhile
            return False

    def _received(self, sink: Sink) -> Mapping[str, float] | None:
        try:
            data = self._socket.recv(MOST_BYTES + 1)
        except TimeoutError:
            return None
        except OSError as error:
            if sink.stopped:
                return None
            raise DataError(f"{self.text} cannot be read any more: {error}; start the session again") from error
        try:
            return row_of(data)
        except DataError as error:
            self._odd += 1
            # The first ones are told, then one in a thousand: a sender that does it all wrong does so at 100 Hz.
            if self._odd <= 3 or self._odd % 1000 == 0:
                sink.note("warning", f"datagram {self._odd} that is no row: {error}", "odd")
            return None

    def _tell_rate(self, sink: Sink, clock: RowClock) -> None:
        rate = clock.measured_hz or math.nan
        if clock.trusted:
            sink.note("note", f"rows come at {rate:.4g} Hz again: models begin anew", "rate right")
            sink.begin_anew()
        else:
            sink.note(
                "warning",
                f"rows come at {rate:.4g} Hz, the models know {self.rate_hz:g} Hz: nothing is predicted",
                "rate wrong",
            )

    def _row(self, message: Mapping[str, float]) -> Row:
        row = np.full(len(self.channels), np.nan)
        for column, channel in enumerate(self.channels):
            row[column] = self._convert(channel.name, message)
        with np.errstate(over="ignore"):
            return row.astype(np.float32)

    def _first_channels(self) -> tuple[Channel, ...]:
        """Those of the first row, where nothing else says which there are."""
        ends = time.monotonic() + STARTUP_S
        while time.monotonic() < ends:
            try:
                message = row_of(self._socket.recv(MOST_BYTES + 1))
            except (TimeoutError, DataError):
                continue
            names = [name for name in message if name != TIME]
            return tuple(VOCABULARY.get(name, Channel(name, Kind.GENERIC)) for name in names[:MOST_CHANNELS])
        self._socket.close()
        raise DataError(
            f"{self.text}: no row came for {STARTUP_S:g} s, and no model or signal map says which channels there are; "
            "start the sender first, or give --map"
        )


def row_of(data: bytes) -> Mapping[str, float]:
    """The values by name of a datagram; NaN for null.

    Raises:
        DataError: it is too long, no JSON object of numbers, or has too many.
    """
    if len(data) > MOST_BYTES:
        raise DataError(f"it has more than {MOST_BYTES} bytes")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"it is no UTF-8 ({error.reason})") from error
    entry = parse_json(text, "the datagram", DataError)
    if not isinstance(entry, dict) or len(entry) > MOST_CHANNELS + 1:
        raise DataError(f"it is no JSON object of at most {MOST_CHANNELS} numbers")
    values = {}
    for name, value in entry.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise DataError(f"the value of {shown(name)} is no number")
        try:
            values[name] = math.nan if value is None else float(value)
        except OverflowError as error:
            raise DataError(f"the value of {shown(name)} is no number of double precision") from error
    if not math.isfinite(values.get(TIME, 0.0)):
        raise DataError(f"its time '{TIME}' is no number")
    return values


def _conversions(signal_map: SignalMap | None) -> Callable[[str, Mapping[str, float]], float]:
    """From a channel's name and a row to its value in SI units."""
    entries: dict[str, Any] = {entry.name: entry for entry in (signal_map.channels if signal_map else ())}
    units = {
        name: conversion(entry.unit, entry.channel().kind, f"signal map, channel '{name}'")
        for name, entry in entries.items()
        if entry.unit is not None
    }

    def convert(name: str, message: Mapping[str, float]) -> float:
        entry = entries.get(name)
        if entry is None:
            return message.get(name, math.nan)
        if entry.constant is not None:
            return float(entry.constant)
        value = float(message.get(entry.column, math.nan) * entry.scale)
        unit = units.get(name)
        return value if unit is None else value * unit.factor + unit.offset

    return convert
