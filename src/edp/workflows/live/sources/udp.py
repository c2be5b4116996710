"""``--udp``: rows as JSON datagrams, one a tick: ``{"t": 12.34, "CylVels_1": 0.12, ...}``."""

from __future__ import annotations

import math
import select
import socket
import time
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np

from edp.errors import ConfigError, DataError
from edp.live.addresses import LOOPBACK, resolve_bind
from edp.logs.units import channel_from_entry, check_unit, unit_for
from edp.settings.bounds import shown
from edp.signals import VOCABULARY, Channel, Kind, SignalMap
from edp.storage.reading import Table, parse_json
from edp.wording import typed
from edp.workflows.live.sources.arrivals import Arrivals
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Row, Sink, SourceOptions, choose_rate

MOST_BYTES = 16_384
"""Maximum size of a datagram: 400 channels. The limit of a network is 65,507 bytes."""
MOST_CHANNELS = 256
BUFFER_BYTES = 1 << 20
"""Receive buffer while the models are busy: some seconds of rows."""
POLL_S = 0.1
STARTUP_S = 30.0
"""Maximum wait for the first row, which defines the channels if no model does."""
TIME = "t"


@SOURCES.register("udp")
class UdpSource(LiveSource):
    """Datagrams on a port; each one is a row with its names.

    Args:
        port: port to listen on.
        rate_hz: rate of the rows.
        channels: channels to take; None for those of the first row.
        signal_map: columns and units to channels; None takes names as channels in SI units.
        host: address to listen on.

    Raises:
        ConfigError: the port is no port, or in use, or `host` is not an address of this computer.
    """

    steered: ClassVar[bool] = False
    options: ClassVar[frozenset[str]] = frozenset({"map", "rate", "machine", "udp-bind", "until-end"})
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
        self._bind = resolve_bind(host, "--udp-bind")
        family = socket.AF_INET6 if ":" in self._bind.numeric else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        try:
            self._socket.bind((self._bind.numeric, port))
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
    def from_options(cls, options: SourceOptions, needs: Needs) -> UdpSource:
        """Return `SourceOptions.value` is the port; the setting ``bind`` another address than loopback."""
        rate, signal_map = choose_rate(options, needs, "--udp"), options.signal_map()
        mapped = tuple(channel_from_entry(entry) for entry in signal_map.channels) if signal_map else ()
        names = {channel.name for channel in mapped}
        channels = (*mapped, *(channel for channel in needs.channels if channel.name not in names))
        host = options.settings.get("bind", LOOPBACK)
        source = cls(int(options.value), rate, channels or None, signal_map, host)
        source.machine = options.machine
        return source

    def run(self, sink: Sink) -> None:
        """Receive rows (see `LiveSource`); a datagram that is not a row is skipped, counted and reported."""
        if not self._bind.is_loopback:
            sink.note("warning", f"rows are taken from {self._bind.reach}, whoever sends them")
        arrivals = Arrivals(sink, self.rate_hz)
        while not sink.stopped:
            message = self._receive(sink)
            if message is None:
                arrivals.wait()
            else:
                arrivals.take(self._row(message), message.get(TIME), self._waits())

    def close(self) -> None:
        """See `LiveSource`."""
        self._socket.close()

    def _waits(self) -> bool:
        """Test whether another datagram waits: the models are slower than the sender."""
        try:
            return bool(select.select([self._socket], [], [], 0.0)[0])
        except (OSError, ValueError):  # closed meanwhile
            return False

    def _receive(self, sink: Sink) -> Mapping[str, float] | None:
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
            sink.leave_out(str(error))
            return None

    def _row(self, message: Mapping[str, float]) -> Row:
        row = np.full(len(self.channels), np.nan)
        for column, channel in enumerate(self.channels):
            row[column] = self._convert(channel.name, message)
        return row

    def _first_channels(self) -> tuple[Channel, ...]:
        """Return the channels of the first row if the settings do not state them."""
        ends = time.monotonic() + STARTUP_S
        while time.monotonic() < ends:
            try:
                message = row_of(self._socket.recv(MOST_BYTES + 1))
            except (TimeoutError, DataError):
                continue
            names = [name for name in message if name != TIME]
            if not names:
                continue
            return tuple(VOCABULARY.get(name, Channel(name, Kind.GENERIC)) for name in names[:MOST_CHANNELS])
        self._socket.close()
        raise DataError(
            f"{self.text}: no row with a value came for {typed(STARTUP_S)} s, and no model or signal map says which "
            "channels there are; start the sender first, or give --map"
        )


def row_of(data: bytes) -> Mapping[str, float]:
    """Return the values of a datagram by name; NaN for null.

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
    """Return a function for each channel that converts a value of a row to SI units."""
    entries: Table = {entry.name: entry for entry in (signal_map.channels if signal_map else ())}
    units = {
        name: unit_for(check_unit(entry.unit, where), channel_from_entry(entry).kind, where)
        for name, entry in entries.items()
        if entry.unit is not None and (where := f"signal map, channel '{name}'")
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
