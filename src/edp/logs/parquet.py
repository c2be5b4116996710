"""Parquet: EDP's own store (float32 columns with unit and kind, rate in the metadata) and anyone else's tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edp.errors import DataError
from edp.logs.own import OwnFacts, facts_text, own_facts
from edp.logs.raw import FORMATS, Column, RawLog, RawSignal, WriteOptions, find_time, time_factor
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import Kind, SignalMap

_MAGIC = b"PAR1"
_KEY = b"edp_recording"
_GROUP_ROWS = 1 << 17


class ParquetFormat:
    """Apache Parquet."""

    name = "parquet"
    suffixes: tuple[str, ...] = (".parquet", ".pq")
    content = "Parquet"
    parts = False

    def claims(self, head: bytes) -> bool:
        """Begins with Parquet's magic number."""
        return head.startswith(_MAGIC)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read the footer; each column is read from disk when its values are asked for."""
        with path.open("rb") as stream:
            stream.seek(0, 2)
            stream.seek(max(stream.tell() - 4, 0))
            tail = stream.read(4)
        if tail != _MAGIC:
            raise DataError(f"'{path}' is a Parquet file whose end is missing (truncated); copy or export it again")
        try:
            parquet = pq.ParquetFile(path, page_checksum_verification=True)
            schema, rows = parquet.schema_arrow, parquet.metadata.num_rows
        except (pa.ArrowException, OSError, ValueError) as error:
            raise DataError(f"'{path}' is a damaged Parquet file: {error}") from error
        own = _own(schema.metadata or {}, path)
        fields = [field for field in schema if _is_number(field.type)]
        time = None
        time_name = None if own.rate_hz else find_time([field.name for field in schema], signal_map, path)
        if time_name is not None:
            time = _stamps(parquet, schema.field(time_name), path, signal_map)
        signals = {field.name: _signal(parquet, field, path, rows, time) for field in fields if field.name != time_name}
        return RawLog(path, signals, **own.for_log())

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write float32 columns in groups of rows; there is no time column: row k is at k / rate_hz."""
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
                use_byte_stream_split=True,
                write_page_checksum=True,
            ) as writer,
        ):
            for start in range(0, recording.samples, _GROUP_ROWS):
                block = recording.values[start : start + _GROUP_ROWS]
                arrays = [pa.array(np.ascontiguousarray(block[:, i]), pa.float32()) for i in range(len(fields))]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=_GROUP_ROWS)


FORMATS.register("parquet")(ParquetFormat())


def _own(metadata: dict[bytes, bytes], path: Path) -> OwnFacts:
    return own_facts(metadata[_KEY].decode(errors="replace"), f"'{path}'") if _KEY in metadata else OwnFacts()


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))


def _read(parquet: pq.ParquetFile, name: str, path: Path) -> pa.ChunkedArray:
    try:
        return parquet.read(columns=[name], use_threads=False).column(0)
    except (pa.ArrowException, OSError, ValueError, IndexError) as error:
        raise DataError(f"'{path}': column '{name}' is damaged: {error}") from error


def _values(parquet: pq.ParquetFile, name: str, path: Path) -> Column:
    column = _read(parquet, name, path)
    if column.null_count or not pa.types.is_floating(column.type):
        column = column.cast(pa.int8()) if pa.types.is_boolean(column.type) else column
        column = column.cast(pa.float64(), safe=False)
    return np.asarray(column.to_numpy(), dtype=np.float64)


def _signal(parquet: pq.ParquetFile, field: pa.Field, path: Path, rows: int, time: Column | None) -> RawSignal:
    known = (field.metadata or {}).items()
    facts = {key.decode(errors="replace"): value.decode(errors="replace") for key, value in known}
    kind = facts.get("kind")
    return RawSignal(
        field.name,
        lambda: _values(parquet, field.name, path),
        rows,
        time,
        unit=normalise_unit(facts.get("unit") or facts.get("units") or facts.get("Unit")),
        kind=Kind(kind) if kind in set(Kind) else None,
        description=facts.get("description", ""),
    )


def _stamps(parquet: pq.ParquetFile, field: pa.Field, path: Path, signal_map: SignalMap) -> Column:
    """Time in seconds from a column of numbers, time stamps or durations."""
    if pa.types.is_timestamp(field.type) or pa.types.is_duration(field.type):
        numbers = _read(parquet, field.name, path).to_numpy()
        first = numbers[:1] if pa.types.is_timestamp(field.type) else np.zeros(1, dtype=numbers.dtype)
        return np.asarray((numbers - first) / np.timedelta64(1, "s"), dtype=np.float64)
    if not _is_number(field.type):
        raise DataError(f"'{path}': time column '{field.name}' holds {field.type}; expected numbers or time stamps")
    facts = field.metadata or {}
    unit = (facts.get(b"unit") or facts.get(b"units") or b"").decode(errors="replace")
    return _values(parquet, field.name, path) * time_factor(field.name, normalise_unit(unit), signal_map)
