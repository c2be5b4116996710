"""Parquet: EDP's own store (float32 columns with unit and kind, rate in the metadata) and anyone else's tables.

Tables of Simulink and its targets are among these: one time column for all or one a signal, vectors as lists.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from edp.errors import DataError, brief
from edp.logs.formats.base import (
    FORMATS,
    PIECE_ROWS,
    Column,
    RawLog,
    RawSignal,
    WriteOptions,
    check_names,
    find_time,
    load_column,
    time_factor,
)
from edp.logs.formats.edp_metadata import EdpMetadata, facts_text, parse_edp_metadata
from edp.logs.formats.names import only, told_apart
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import Kind, SignalMap
from edp.storage.memory import check_memory

_MAGIC = b"PAR1"
_KEY = b"edp_recording"
_GROUP_ROWS = 1 << 17
"""Number of rows per row group: 22 min at 100 Hz."""
_LARGEST_LIST = 256
"""Maximum length of a list that becomes columns. Longer lists are pictures and spectra."""
RATIO = 1100
"""Maximum ratio of value bytes to file bytes, as in the other formats."""
SPARE = 1 << 28
"""Additional value bytes that are always allowed. Constant columns compress well: an hour at 1 kHz takes 29 MB."""
_COPIES = 2
"""Number of copies of a column in memory: in segments and contiguous."""


class ParquetFormat:
    """Apache Parquet."""

    name = "parquet"
    suffixes: tuple[str, ...] = (".parquet", ".pq")
    content = "Parquet"
    libraries = ("pandas",)  # which pyarrow imports when columns become arrays

    def claims(self, head: bytes) -> bool:
        """Return whether the file starts with Parquet's magic number."""
        return head.startswith(_MAGIC)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read the footer; each column is read from disk on demand."""
        with path.open("rb") as stream:
            stream.seek(0, 2)
            # The footer is written last: its magic number at the end tells a whole file.
            stream.seek(max(stream.tell() - 4, 0))
            tail = stream.read(4)
        if tail != _MAGIC:
            raise DataError(f"'{path}' is a Parquet file whose end is missing (truncated); copy or export it again")
        try:
            table = _Table(path)
        except (pa.ArrowException, OSError, ValueError) as error:
            advice = "decrypt it with its keys first" if "crypt" in str(error) else "copy or export it again"
            raise DataError(f"'{path}' is a damaged or encrypted Parquet file: {brief(error)}; {advice}") from error
        edp_metadata = _edp_metadata(table.schema.metadata or {}, path)
        clocks = {} if edp_metadata.rate_hz else _clocks(table, signal_map)
        times = {clock.field_index for clock in clocks.values()}
        named_signals = []
        for field_index, field in enumerate(table.schema):
            if field_index not in times:
                named_signals += _signals(table, field_index, field, clocks.get(field_index))
        signals, aliases, repeated = told_apart(named_signals)
        if edp_metadata.channels:
            signals, repeated = only(edp_metadata.channels, signals, repeated)
        return RawLog(path, signals, aliases=aliases, repeated=repeated, **edp_metadata.to_log_metadata())

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write float32 columns in row groups without a time column: row k is at k / rate_hz."""
        fields = [
            pa.field(
                channel.name,
                pa.float32(),
                metadata={"unit": channel.unit, "kind": str(channel.kind), "description": channel.description},
            )
            for channel in recording.channels
        ]
        schema = pa.schema(fields, metadata={_KEY: facts_text(recording).encode()})
        with (
            path.open("wb") as stream,
            pq.ParquetWriter(
                stream,
                schema,
                compression="zstd",
                use_dictionary=False,
                # Bytes of equal weight beside each other: noisy floats pack better so; dictionaries do not help.
                use_byte_stream_split=True,
                write_page_checksum=True,
            ) as writer,
        ):
            for start in range(0, recording.samples, _GROUP_ROWS):
                block = recording.values[start : start + _GROUP_ROWS]
                arrays = [pa.array(np.ascontiguousarray(block[:, i]), pa.float32()) for i in range(len(fields))]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=_GROUP_ROWS)


FORMATS.register("parquet")(ParquetFormat())


def _edp_metadata(metadata: dict[bytes, bytes], path: Path) -> EdpMetadata:
    return (
        parse_edp_metadata(metadata[_KEY].decode(errors="replace"), f"'{path}'") if _KEY in metadata else EdpMetadata()
    )


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def _is_list(kind: pa.DataType) -> bool:
    lists = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    return bool(lists and _is_number(kind.value_type))


def _is_time(kind: pa.DataType) -> bool:
    return bool(pa.types.is_timestamp(kind) or pa.types.is_duration(kind))


class _Table:
    """A file; columns go by their place, since names may occur twice, and by an element where they hold lists."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = pq.ParquetFile(path, page_checksum_verification=True)
        self.schema = self.file.schema_arrow
        self.rows = int(self.file.metadata.num_rows)
        self.which = [0] * len(self.schema.names)
        for places in _group_by_name(self.schema.names).values():
            for which, field_index in enumerate(places):
                self.which[field_index] = which
        self.weigh()

    def weigh(self) -> None:
        """Refuse a file that announces more data than memory allows, since runs of equal values compress without limit.

        Raises:
            DataError: more rows, or more values of lists, than the bytes of the file can mean or memory can take.
        """
        about = self.file.metadata
        check_names(self.path, self.schema.names)
        column_bytes = [0] * about.num_columns
        for number in range(about.num_row_groups):
            group = about.row_group(number)
            for column in range(about.num_columns):
                column_bytes[column] += max(int(group.column(column).num_values), int(group.num_rows))
        largest, size = 8 * max([self.rows, *column_bytes]), self.path.stat().st_size
        if self.rows < 0 or largest > RATIO * size + SPARE:
            raise DataError(
                f"'{self.path}': a column claims {largest // 8} values in a file of {size} bytes; it may be damaged, "
                "or was made to exhaust memory: copy or export it again"
            )
        check_memory(self.path, _COPIES * largest, "a column", "split the file")

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`; a name is ``PLACE`` or ``PLACE.ELEMENT``."""
        keys = [tuple(int(part) for part in name.split(".")) for name in names]
        seen = start
        for first, columns in self.batches([key[0] for key in keys], start, stop):
            seen = max(seen, first + len(columns[0]))
            low, high = max(start - first, 0), min(stop - first, len(columns[0]))
            if high > low:
                yield [_numbers(column.slice(low, high - low), *key[1:]) for column, key in zip(columns, keys)]
        if seen < stop:
            raise DataError(
                f"'{self.path}' announces {self.rows} rows and ends after {seen} (truncated); copy or export it again"
            )

    def batches(self, places: Sequence[int], start: int, stop: int) -> Iterator[tuple[int, list[pa.Array]]]:
        """Yield the first row of each batch and its columns; row groups outside the range are not read."""
        names = self.schema.names
        groups, first, skipped = [], 0, 0
        for number in range(self.file.metadata.num_row_groups):
            rows = self.file.metadata.row_group(number).num_rows
            if first < stop and first + rows > start:
                groups.append(number)
            elif first + rows <= start:
                skipped = first + rows
            first += rows
        column_names = list(dict.fromkeys(names[field_index] for field_index in places))
        try:
            for batch in self.file.iter_batches(PIECE_ROWS, row_groups=groups, columns=column_names):
                columns_by_name = _group_by_name(batch.schema.names)
                yield (
                    skipped,
                    [
                        batch.column(columns_by_name[names[field_index]][self.which[field_index]])
                        for field_index in places
                    ],
                )
                skipped += batch.num_rows
        except (pa.ArrowException, OSError, ValueError, IndexError) as error:
            shown = ", ".join(column_names[:4])
            raise DataError(
                f"'{self.path}': column(s) {shown} cannot be read ({brief(error)}); copy or export it"
            ) from error

    def whole(self, field_index: int) -> pa.Array:
        """Return one column."""
        parts = [columns[0] for _, columns in self.batches([field_index], 0, self.rows)]
        return pa.concat_arrays(parts) if parts else pa.array([], self.schema.field(field_index).type)


def _group_by_name(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the column positions of each name; duplicate names keep their order."""
    places: dict[str, list[int]] = {}
    for field_index, name in enumerate(names):
        places.setdefault(name, []).append(field_index)
    return places


def _numbers(column: pa.Array, element: int | None = None) -> NDArray[Any]:
    """Return the values; NaN for missing ones."""
    if element is not None:
        column = pc.list_element(column, element)
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    # Integers have no NaN for the missing ones.
    if column.null_count:
        column = column.cast(pa.float64(), safe=False)
    return np.asarray(column.to_numpy(zero_copy_only=False))


@dataclass(frozen=True, eq=False)
class _Clock:
    """A time column: its place, stamps in seconds, and the rows that have one."""

    field_index: int
    stamps: Column

    @staticmethod
    def read(table: _Table, field_index: int, signal_map: SignalMap, shared: bool) -> _Clock:
        stamps = _stamps(table, field_index, signal_map)
        if not shared and len(stamps):
            # Signals of other rates fill the rest of the rows with nothing.
            filled = np.flatnonzero(np.isfinite(stamps))
            stamps = stamps[: int(filled[-1]) + 1 if len(filled) else 0]
        return _Clock(field_index, stamps)


def _clocks(table: _Table, signal_map: SignalMap) -> dict[int, _Clock]:
    """Return the clock of each column: one common clock, or the time column of each signal, as Simulink writes it."""
    names = table.schema.names
    time_of_field = {} if signal_map.time or signal_map.sample_time_s else _times_of_fields(table.schema)
    if len(set(time_of_field.values())) > 1:
        read = {
            field_index: _Clock.read(table, field_index, signal_map, shared=False)
            for field_index in set(time_of_field.values())
        }
        return {field_index: read[time] for field_index, time in time_of_field.items()}
    name = find_time(names, signal_map, table.path)
    if name is None:
        return {}
    if names.count(name) > 1:
        raise DataError(f"'{table.path}' has {names.count(name)} time columns named '{name}'; rename all but one")
    clock = _Clock.read(table, names.index(name), signal_map, shared=True)
    return dict.fromkeys(range(len(names)), clock)


def _times_of_fields(schema: pa.Schema) -> dict[int, int]:
    """Return columns with their own time column: ``X_time`` for ``X``, or the nearest ``time`` to the left."""
    names = [name.lower() for name in schema.names]
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        first.setdefault(name, i)
    usable = [_is_time(field.type) or pa.types.is_floating(field.type) for field in schema]
    plain = [i for i, name in enumerate(names) if usable[i] and re.fullmatch(r"time[_ ]?\d*", name)]
    pairs = {}
    for i, name in enumerate(names):
        for spelling in (f"{name}_time", f"{name}.time", f"{name}:time", f"time_{name}"):
            if spelling in first and usable[first[spelling]]:
                pairs[i] = first[spelling]
    if pairs:
        return pairs
    if len(plain) < 2:
        return {}
    times = set(plain)
    return {i: plain[bisect_left(plain, i) - 1] for i in range(plain[0] + 1, len(names)) if i not in times}


def _signals(table: _Table, field_index: int, field: pa.Field, clock: _Clock | None) -> list[tuple[str, RawSignal]]:
    """Return the columns of one field: the field itself, or the elements of its lists."""
    if _is_number(field.type):
        parts = [(field.name, str(field_index))]
    elif _is_list(field.type):
        width = _width(table, field_index)
        parts = [(f"{field.name}_{i + 1}", f"{field_index}.{i}") for i in range(width)]
    else:
        return []
    metadata = (field.metadata or {}).items()
    facts = {key.decode(errors="replace"): value.decode(errors="replace") for key, value in metadata}
    kind = facts.get("kind")
    samples = table.rows if clock is None else len(clock.stamps)
    named_signals = []
    for name, key in parts:
        signal = RawSignal(
            name,
            partial(load_column, table, key, samples),
            samples,
            None if clock is None else clock.stamps,
            unit=normalise_unit(facts.get("unit") or facts.get("units") or facts.get("Unit") or facts.get("Units")),
            kind=Kind(kind) if kind in set(Kind) else None,
            description=facts.get("description", ""),
            table=table,
            key=key,
        )
        named_signals.append((f"column_{field_index + 1}.{name}", signal))
    return named_signals


def _width(table: _Table, field_index: int) -> int:
    """Return elements of the lists of a column; 0 where they differ, such as signals of variable size, or are many."""
    kind = table.schema.field(field_index).type
    if pa.types.is_fixed_size_list(kind):
        return int(kind.list_size) if kind.list_size <= _LARGEST_LIST else 0
    widths: set[int] = set()
    for _, columns in table.batches([field_index], 0, table.rows):
        widths |= set(pc.unique(pc.list_value_length(columns[0])).to_pylist()) - {None}
        if len(widths) > 1:
            return 0
    width = widths.pop() if widths else 0
    return int(width) if width <= _LARGEST_LIST else 0


def _stamps(table: _Table, field_index: int, signal_map: SignalMap) -> Column:
    """Return time in seconds from a column of values, time stamps or durations; NaN for missing entries."""
    field = table.schema.field(field_index)
    if _is_time(field.type):
        numbers = table.whole(field_index).to_numpy(zero_copy_only=False)
        first = numbers[:1] if pa.types.is_timestamp(field.type) else np.zeros(1, dtype=numbers.dtype)
        return np.asarray((numbers - first) / np.timedelta64(1, "s"), dtype=np.float64)
    if not _is_number(field.type):
        raise DataError(
            f"'{table.path}': time column '{field.name}' holds {field.type}; expected numbers or time stamps"
        )
    facts = field.metadata or {}
    unit = (facts.get(b"unit") or facts.get(b"units") or b"").decode(errors="replace")
    stamps = _numbers(table.whole(field_index)).astype(np.float64)
    return stamps * time_factor(field.name, normalise_unit(unit), signal_map)
