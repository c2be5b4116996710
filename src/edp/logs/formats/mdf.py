"""ASAM MDF 4: measurement files of CAN loggers and calibration tools, read and written through asammdf.

Channels are selected group by group and brought to the grid by `edp.logs.timebase`; asammdf's own union of time stamps
is not used.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, brief
from edp.logs.formats.base import FORMATS, PIECE_ROWS, Column, RawLog, RawSignal, WriteOptions, load_column
from edp.logs.formats.edp_metadata import EdpMetadata, facts_text, parse_edp_metadata
from edp.logs.formats.mdf_check import check_blocks
from edp.logs.formats.mdf_conversion import Conversion, refuse_engines
from edp.logs.formats.mdf_events import LogEvent, event_blocks
from edp.logs.formats.names import only, quote_name, told_apart
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import SignalMap
from edp.storage.unpacking import unpack_to

_MAGIC = (b"MDF     ", b"UnFinMF ")
_FACTS = "edp_info.json"
_FACTS_BYTES = 1 << 24
"""Maximum size of the metadata in bytes. A thousand channels take 150 kB."""
_PIECE_BYTES = 1 << 25
"""Size of the records read at a time, so that wide groups take larger steps than `PIECE_ROWS`."""
_NUMBERS = range(6)
"""Data types of integers and floats. Higher numbers are texts, bytes, dates and pictures."""
_PLAIN_TYPES = (0, 2, 3, 6)
"""Supported channel types: fixed length, master, virtual master, virtual."""
_TIME = 1
"""Synchronisation type of a master channel in seconds. Other types are angle, distance and record index."""


class MdfFormat:
    """ASAM MDF 4."""

    name = "mdf"
    suffixes: tuple[str, ...] = (".mf4", ".mdf")
    content = "MDF"
    libraries = ("asammdf",)

    def claims(self, head: bytes) -> bool:
        """Return whether the file starts with MDF's identification."""
        return head.startswith(_MAGIC)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read names, units and groups; values and times are read on demand."""
        asammdf = _library()
        # Before the library opens the file, which follows every link.
        check_blocks(path)
        with _damage(path):
            stream = path.open("rb")
            try:
                # A stream keeps the library from reading a whole group when a part of it is asked for.
                log = asammdf.MDF(
                    stream, process_bus_logging=False, use_display_names=False, raise_on_multiple_occurrences=False
                )
            except BaseException:
                stream.close()
                raise
            file = _File(path, log)
            # Columns are read later: the file closes when the last of them is gone.
            weakref.finalize(file, _close, log, stream)
            edp_metadata = file.facts()
            named_signals = [
                signal for number in range(len(log.groups)) for signal in file.group(number, edp_metadata, signal_map)
            ]
        if not named_signals:
            raise DataError(f"'{path}' holds no channels of numbers; {_advice(log)}")
        signals, aliases, repeated = told_apart(named_signals)
        if edp_metadata.channels:
            signals, repeated = only(edp_metadata.channels, signals, repeated)
        return RawLog(path, signals, aliases=aliases, repeated=repeated, **edp_metadata.to_log_metadata())

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write one packed channel group of float32 with the time in s, and EDP's metadata as an attachment."""
        self.write_with_events(recording, path, ())

    def write_with_events(self, recording: Recording, path: Path, events: Sequence[LogEvent]) -> None:
        """Write the recording with event blocks.

        Raises:
            DataError: too many events.
        """
        asammdf = _library()
        time = np.arange(recording.samples) / recording.rate_hz
        signals = [
            asammdf.Signal(
                samples=np.ascontiguousarray(recording.values[:, channel_index]),
                timestamps=time,
                name=channel.name,
                unit=channel.unit,
                comment=channel.description,
            )
            for channel_index, channel in enumerate(recording.channels)
        ]
        with asammdf.MDF(version="4.10") as log, path.open("wb+") as stream:
            log.append(signals, acq_name=recording.name, comment="EDP", common_timebase=True)
            log.attach(facts_text(recording).encode(), file_name=_FACTS, mime="application/json")
            log.events = event_blocks(events)
            # 2 packs transposed records: bytes of equal weight lie beside each other.
            log.save(stream, compression=2)


FORMATS.register("mdf")(MdfFormat())


class _File:
    """An open file."""

    def __init__(self, path: Path, log: Any) -> None:
        self.path = path
        self.log = log
        self.conversions: dict[tuple[int, int], Any] = {}
        self._take_conversions()

    def _take_conversions(self) -> None:
        """Take the conversions out of the library's hands before it reads a value: it runs formulas as code."""
        for number, group in enumerate(self.log.groups):
            for channel_index, channel in enumerate(group.channels):
                if channel.conversion is not None:
                    self.conversions[number, channel_index] = channel.conversion
                    channel.conversion = None

    def convert(self, number: int, channel_index: int, raw: NDArray[Any]) -> NDArray[Any]:
        """Return the physical values of a channel."""
        block = self.conversions.get((number, channel_index))
        if block is None:
            return raw
        name = self.log.groups[number].channels[channel_index].name
        return Conversion(block, f"'{self.path}', channel {quote_name(name)}")(raw)

    def facts(self) -> EdpMetadata:
        for attachment in self.log.attachments:
            if attachment.file_name == _FACTS:
                where = f"'{self.path}', attachment '{_FACTS}'"
                return parse_edp_metadata(_read_embedded(attachment, where).decode(errors="replace"), where)
        return EdpMetadata()

    def group(self, number: int, edp_metadata: EdpMetadata, signal_map: SignalMap) -> list[tuple[str, RawSignal]]:
        """Return the numeric channels of one group, each with its full name."""
        group = self.log.groups[number]
        samples = int(group.channel_group.cycles_nr)
        master = self.log.masters_db.get(number)
        timed = master is not None and group.channels[master].sync_type == _TIME
        stamps = None
        if timed and edp_metadata.rate_hz is None and signal_map.sample_time_s is None:
            stamps = cache(partial(self.stamps, number))
        table = _Table(self, number)
        named_signals = []
        for channel_index, channel in enumerate(group.channels):
            usable = channel.data_type in _NUMBERS and channel.channel_type in _PLAIN_TYPES
            if channel_index == master or not usable or group.channel_dependencies[channel_index] or not samples:
                continue
            channel_facts = edp_metadata.channels.get(channel.name)
            conversion = self.conversions.get((number, channel_index))
            unit = channel.unit or (conversion.unit if conversion else "")
            key = str(channel_index)
            signal = RawSignal(
                channel.name,
                partial(load_column, table, key, samples),
                samples,
                stamps,
                unit=normalise_unit(unit) or (channel_facts.unit if channel_facts else None),
                kind=channel_facts.kind if channel_facts else None,
                description=channel_facts.description if channel_facts else "",
                table=table,
                key=key,
            )
            named_signals.append((f"{self.name_of(number)}.{channel.name}", signal))
        return named_signals

    def name_of(self, number: int) -> str:
        head = self.log.groups[number].channel_group
        source = head.acq_source.name if head.acq_source else ""
        return str(head.acq_name or source or f"group_{number}")

    def stamps(self, number: int) -> Column:
        with _damage(self.path):
            raw = np.asarray(self.log.get_master(number))
        return np.array(self.convert(number, self.log.masters_db[number], raw), dtype=np.float64)


class _Table:
    """One channel group."""

    def __init__(self, file: _File, number: int) -> None:
        self.file = file
        self.number = number

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`."""
        head = self.file.log.groups[self.number].channel_group
        rows = max(PIECE_ROWS, _PIECE_BYTES // max(int(head.samples_byte_nr), 1))
        chosen = [(None, self.number, int(name)) for name in names]
        for first in range(start, stop, rows):
            count = min(rows, stop - first)
            with _damage(self.file.path):
                selected = self.file.log.select(
                    chosen,
                    record_offset=first,
                    record_count=count,
                    copy_master=False,
                    # Raw values: the library would apply conversions, formulas among them.
                    raw=True,
                )
                columns = [_plain(signal) for signal in selected]
            for signal, column in zip(selected, columns):
                if column.dtype.kind not in "fiub" or column.ndim != 1:
                    raise DataError(f"'{self.file.path}': column '{signal.name}' holds no plain numbers; map another")
                if len(column) != count:
                    raise DataError(
                        f"'{self.file.path}': column '{signal.name}' ends after {first + len(column)} rows, {stop} "
                        "were announced (truncated); copy or export it again"
                    )
            yield [
                _valid(signal, self.file.convert(self.number, int(name), column))
                for signal, column, name in zip(selected, columns, names)
            ]


def _plain(signal: Any) -> NDArray[Any]:
    return np.asarray(signal.samples)


def _valid(signal: Any, values: NDArray[Any]) -> NDArray[Any]:
    """Return the values with NaN where the file marks them as invalid."""
    if signal.invalidation_bits is None:
        return values
    invalid = np.asarray(signal.invalidation_bits, dtype=np.bool_)
    return np.where(invalid, np.nan, values) if invalid.any() else values


def _read_embedded(attachment: Any, where: str) -> bytes:
    """Return the bytes of an attachment inside the file, unpacked up to `_FACTS_BYTES`; no other file is opened.

    Raises:
        DataError: the attachment lies outside the file, is packed in another way than deflate, or is too large.
    """
    embedded, packed, otherwise = (bool(attachment.flags & flag) for flag in (1, 2, 8))
    data = bytes(attachment.embedded_data)
    if not embedded or otherwise or (packed and attachment.zip_type):
        raise DataError(f"{where}: is not embedded as EDP embeds it; it is damaged: copy or export the file again")
    if packed:
        # One byte more than allowed tells that there is more.
        data = unpack_to("zlib", data, _FACTS_BYTES)
    if len(data) > _FACTS_BYTES:
        raise DataError(f"{where}: is larger than {_FACTS_BYTES} bytes; it is damaged: copy or export the file again")
    return data


def _close(log: Any, stream: Any) -> None:
    log.close()
    stream.close()


def _advice(log: Any) -> str:
    names = {channel.name for group in log.groups for channel in group.channels}
    if any(name.startswith(("CAN_DataFrame", "LIN_Frame", "FLX_Frame", "ETH_Frame")) for name in names):
        return "it logs raw bus frames: decode them with their database (DBC, ARXML) and save the signals"
    return f"channels: {', '.join(sorted(names)[:12]) or 'none'}"


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Convert any exception of the library on damaged bytes into one DataError."""
    logger = logging.getLogger("asammdf")
    level = logger.level
    # The library logs each defect with its stack; the message to the user says it once.
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    except DataError:
        raise
    except MemoryError as error:
        raise DataError(
            f"'{path}' announces more data than this machine has memory for; it may be damaged: copy or export it again"
        ) from error
    except Exception as error:
        raise DataError(
            f"'{path}' cannot be read as MDF ({type(error).__name__}: {brief(error)}); it may be truncated or "
            "damaged: copy or export it again"
        ) from error
    finally:
        logger.setLevel(level)


def _library() -> ModuleType:
    try:
        import asammdf
    except ImportError as error:
        raise DataError(
            "MDF files need the package asammdf, which is not installed; run pip install "
            "'excavator-dynamics-predictor[mdf]', or export the file as MAT or CSV with your measurement tool"
        ) from error
    refuse_engines(asammdf)
    return asammdf
