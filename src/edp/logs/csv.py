"""CSV: any delimiter, decimal comma, units in the header or in a row of their own, or no header at all."""

from __future__ import annotations

import csv as text_csv
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as arrow_csv

from edp.errors import DataError
from edp.logs.raw import FORMATS, Column, RawLog, RawSignal, WriteOptions, find_time, time_factor
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import TIME_UNITS, UNITS, SignalMap

_HEAD_BYTES = 1 << 18
_DELIMITERS = (",", ";", "\t", "|")
_NULLS = ["", "NaN", "nan", "NAN", "NA", "N/A", "#N/A", "null", "NULL", "-nan", "-nan(ind)", "1.#QNAN"]
_NAME_UNIT = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))$")
_BLOCK_ROWS = 65536


@dataclass(frozen=True)
class _Layout:
    """How a text file is laid out: its columns with units, and where its numbers begin."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    numeric: tuple[bool, ...]
    delimiter: str
    decimal: str
    skip_rows: int
    encoding: str


class CsvFormat:
    """Comma, semicolon or tab separated text."""

    name = "csv"
    suffixes: tuple[str, ...] = (".csv", ".tsv")
    content = "CSV text"
    parts = False

    def claims(self, head: bytes) -> bool:
        """Text without NUL bytes, or UTF-16 with its mark."""
        if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return True
        printable = sum(byte >= 32 or byte in b"\t\r\n\f" for byte in head)
        return bool(head) and b"\0" not in head and printable == len(head)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read a text file; empty cells are missing values."""
        layout = _layout(path, signal_map)
        table = _table(path, layout)
        names = [name for name in layout.names if name]
        time_name = find_time(names, signal_map, path)
        time = None
        if time_name is not None:
            place = layout.names.index(time_name)
            time = _stamps(table.column(place), path, time_name, layout, signal_map)
        signals: dict[str, RawSignal] = {}
        for place, name in enumerate(layout.names):
            if not name or name == time_name:
                continue
            column = table.column(place)
            if name in signals:
                signals[name] = _ambiguous(path, name, table.num_rows, time)
                continue
            signals[name] = RawSignal(
                name, _loader(column, path, name, layout), table.num_rows, time, unit=layout.units[place]
            )
        return RawLog(path, signals)

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write ``time_s`` and every channel as ``name [unit]``; numbers read back bit for bit."""
        header = ["time_s"] + [f"{channel.name} [{channel.unit}]" for channel in recording.channels]
        columns = [f"c{i}" for i in range(len(header))]
        plain = arrow_csv.WriteOptions(include_header=False)
        with path.open("wb") as stream:
            line = io.StringIO()
            text_csv.writer(line, lineterminator="\n").writerow(header)
            stream.write(line.getvalue().encode())
            for start in range(0, recording.samples, _BLOCK_ROWS):
                block = recording.values[start : start + _BLOCK_ROWS]
                time = np.arange(start, start + len(block)) / recording.rate_hz
                arrays = [pa.array(time)] + [pa.array(np.ascontiguousarray(block[:, i])) for i in range(block.shape[1])]
                arrow_csv.write_csv(pa.table(arrays, names=columns), stream, plain)


FORMATS.register("csv")(CsvFormat())


def _layout(path: Path, signal_map: SignalMap) -> _Layout:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    encoding = _encoding(head)
    lines = head.decode(encoding, errors="replace").splitlines()
    if len(head) == _HEAD_BYTES and len(lines) > 1:
        lines = lines[:-1]
    skip = 0
    while skip < len(lines) and (not lines[skip].strip() or lines[skip].lstrip()[0] in "#%"):
        skip += 1
    lines = lines[skip:]
    if not lines:
        raise DataError(f"'{path}' holds no rows; expected a header row and numbers")
    delimiter = signal_map.delimiter or _delimiter(lines)
    rows = [row for row in text_csv.reader(lines[:200], delimiter=delimiter) if row]
    body = rows[1:] if signal_map.header else rows
    decimal = signal_map.decimal
    if decimal == "." and delimiter != "," and _has_decimal_commas(body):
        decimal = ","
    if signal_map.header:
        names, units, more = _header(path, rows, decimal)
        skip += more
        body = rows[more:]
    else:
        names, units = _stated_columns(path, rows, signal_map)
    numeric = tuple(all(_is_number(row[i], decimal) for row in body if i < len(row)) for i in range(len(names)))
    return _Layout(names, units, numeric, delimiter, decimal, skip, encoding)


def _encoding(head: bytes) -> str:
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        head[: head.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig" if head[:3] == b"\xef\xbb\xbf" else "utf-8"


def _delimiter(lines: list[str]) -> str:
    """The delimiter that splits the first lines into the same, largest number of cells."""
    sample = [line for line in lines[:20] if line.strip()]
    best, most = ",", 0
    for delimiter in _DELIMITERS:
        counts = [len(row) for row in text_csv.reader(sample, delimiter=delimiter)]
        if counts[0] > 1 and counts.count(counts[0]) >= 0.8 * len(counts) and counts[0] > most:
            best, most = delimiter, counts[0]
    return best


def _has_decimal_commas(rows: list[list[str]]) -> bool:
    cells = [cell.strip() for row in rows for cell in row]
    return any(re.fullmatch(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", cell) for cell in cells) and not any(
        re.fullmatch(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?", cell) for cell in cells
    )


def _is_number(cell: str, decimal: str = ".") -> bool:
    text = cell.strip()
    if text in _NULLS:
        return True
    try:
        float(text.replace(decimal, ".") if decimal != "." else text)
    except ValueError:
        return False
    return True


def _header(path: Path, rows: list[list[str]], decimal: str) -> tuple[tuple[str, ...], tuple[str | None, ...], int]:
    """Names, units and the number of header rows (2 with a row of units)."""
    cells = [cell.strip() for cell in rows[0]]
    filled = [cell for cell in cells if cell]
    if not filled or all(_is_number(cell, decimal) for cell in filled):
        raise DataError(
            f"'{path}': the first row holds numbers, not names ({', '.join(cells[:4])}); "
            "set header = false in the signal map and list its columns"
        )
    pairs = [_name_and_unit(cell) for cell in cells]
    names = tuple(name for name, _ in pairs)
    units: list[str | None] = [unit for _, unit in pairs]
    if len(rows) > 1 and _is_unit_row(rows[1], decimal):
        for i, cell in enumerate(rows[1][: len(units)]):
            units[i] = normalise_unit(cell.strip().strip("[]()")) or units[i]
        return names, tuple(units), 2
    return names, tuple(units), 1


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    match = _NAME_UNIT.match(cell)
    if match is None:
        return cell, None
    if match["square"] is not None:
        return match["name"], normalise_unit(match["square"])
    unit = normalise_unit(match["round"])
    return (match["name"], unit) if unit in UNITS or unit in TIME_UNITS else (cell, None)


def _is_unit_row(row: list[str], decimal: str) -> bool:
    cells = [cell.strip().strip("[]()") for cell in row]
    filled = [cell for cell in cells if cell]
    words = [cell for cell in filled if cell != "1"]
    known = [normalise_unit(cell) in UNITS or normalise_unit(cell) in TIME_UNITS for cell in words]
    return any(known) and not any(_is_number(cell, decimal) for cell in words)


def _stated_columns(
    path: Path, rows: list[list[str]], signal_map: SignalMap
) -> tuple[tuple[str, ...], tuple[str | None, ...]]:
    width = len(rows[0])
    if len(signal_map.columns) != width:
        raise DataError(
            f"'{path}' has {width} columns per row and no header; 'columns' of the signal map names "
            f"{len(signal_map.columns)}: name all {width} in order"
        )
    return tuple(signal_map.columns), (None,) * width


def _table(path: Path, layout: _Layout) -> pa.Table:
    """All columns, numbers where they are numbers, text otherwise."""
    keys = [f"c{i}" for i in range(len(layout.names))]
    types = {key: pa.float64() if number else pa.string() for key, number in zip(keys, layout.numeric)}
    ragged: list[Any] = []

    def note(row: Any) -> str:
        ragged.append(row)
        return "skip"

    encoding = "utf-8" if layout.encoding == "utf-8-sig" else layout.encoding
    read = arrow_csv.ReadOptions(
        use_threads=False, column_names=keys, skip_rows=layout.skip_rows, encoding=encoding, block_size=1 << 24
    )
    parse = arrow_csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=note)
    for _ in range(len(keys) + 1):
        convert = arrow_csv.ConvertOptions(column_types=types, null_values=_NULLS, decimal_point=layout.decimal)
        ragged.clear()
        try:
            table = arrow_csv.read_csv(path, read_options=read, parse_options=parse, convert_options=convert)
        except (pa.ArrowException, OSError, ValueError) as error:
            column = re.search(r"CSV column #(\d+)", str(error))
            if column is None or types[keys[int(column[1])]] == pa.string():
                raise DataError(f"'{path}' cannot be read as CSV: {error}") from error
            # Text further down a column of numbers: keep it as text, so that only a map that needs it is refused.
            types[keys[int(column[1])]] = pa.string()
            continue
        if ragged:
            bad = ragged[0]
            raise DataError(
                f"'{path}': line {bad.number} has {bad.actual_columns} cells, the header has {bad.expected_columns} "
                f"('{bad.text[:60]}'); the file may be cut off: export it again or delete the line"
            )
        return table
    raise DataError(f"'{path}' cannot be read as CSV")


def _loader(column: pa.ChunkedArray, path: Path, name: str, layout: _Layout) -> Any:
    def load() -> Column:
        if pa.types.is_string(column.type):
            _refuse_text(column, path, name, layout)
        return np.asarray(column.to_numpy(), dtype=np.float64)

    return load


def _refuse_text(column: pa.ChunkedArray, path: Path, name: str, layout: _Layout) -> None:
    for row, cell in enumerate(column.to_pylist()):
        if not _is_number(cell or "", layout.decimal):
            raise DataError(
                f"'{path}': column '{name}' holds text '{cell[:40]}' in line {row + layout.skip_rows + 1}; "
                "expected a number or an empty cell"
            )
    raise DataError(f"'{path}': column '{name}' holds numbers that cannot be read; check the decimal sign in the map")


def _ambiguous(path: Path, name: str, samples: int, time: Column | None) -> RawSignal:
    def load() -> Column:
        raise DataError(f"'{path}' has two columns named '{name}'; rename one of them")

    return RawSignal(name, load, samples, time)


def _stamps(column: pa.ChunkedArray, path: Path, name: str, layout: _Layout, signal_map: SignalMap) -> Column:
    unit = layout.units[layout.names.index(name)]
    if not pa.types.is_string(column.type):
        return _loader(column, path, name, layout)() * time_factor(name, unit, signal_map)
    cells = [(cell or "NaT").strip().removesuffix("Z") for cell in column.to_pylist()]
    try:
        dates = np.array(cells, dtype="datetime64[ns]")
    except ValueError:
        _refuse_text(column, path, name, layout)
        raise
    stamps = (dates - dates[0]) / np.timedelta64(1, "s")
    return np.asarray(stamps, dtype=np.float64)
