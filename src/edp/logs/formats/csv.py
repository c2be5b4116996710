"""CSV: any delimiter, decimal comma, units in the header or in a row of their own, or no header at all."""

from __future__ import annotations

import csv as text_csv
import io
import re
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as arrow_csv

from edp.errors import DataError
from edp.logs.formats.base import (
    FORMATS,
    MOST_COLUMNS,
    Column,
    RawLog,
    RawSignal,
    WriteOptions,
    check_names,
    find_time,
    load_column,
    time_factor,
)
from edp.logs.formats.csv_table import CsvTable, TextLayout, is_number
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import TIME_UNITS, UNITS, SignalMap

_HEAD_BYTES = (1 << 18, 1 << 22, 1 << 26)
"""How much of a file is looked at for its header: more where comments or the header itself are longer."""
_MOST_CELLS_LOOKED = 200_000
"""Cells in which the layout is looked for; wide tables need fewer rows."""
_DELIMITERS = (",", ";", "\t", "|")
"""In the order in which a tie is decided."""
_NAME_UNIT = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))$")
_STATED = re.compile(r'sep=([^\w\s"]|\t)', re.IGNORECASE)
_ROWS_LOOKED = 200
"""Rows in which the layout is looked for."""
_BLOCK_ROWS = 65536
"""Rows written at a time, so that no second copy of the recording is made."""


class CsvFormat:
    """Comma, semicolon or tab separated text."""

    name = "csv"
    suffixes: tuple[str, ...] = (".csv", ".tsv")
    content = "CSV text"
    libraries = ("pandas",)  # which pyarrow imports when columns become arrays

    def claims(self, head: bytes) -> bool:
        """Text without NUL bytes, or UTF-16 with its mark."""
        if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return True
        printable = sum(byte >= 32 or byte in b"\t\r\n\f" for byte in head)
        return bool(head) and b"\0" not in head and printable == len(head)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read a text file; empty cells are missing values."""
        layout = _layout(path, signal_map)
        table = CsvTable(path, layout)
        names = [name for name in layout.names if name]
        time_name = find_time(names, signal_map, path)
        time = None if time_name is None else _stamps(table, layout.names.index(time_name), signal_map)
        signals: dict[str, RawSignal] = {}
        for column_index, name in enumerate(layout.names):
            if not name or name == time_name:
                continue
            if name in signals:
                signals[name] = _ambiguous(path, name, table.rows, time)
                continue
            key = str(column_index)
            load = partial(load_column, table, key, table.rows)
            signals[name] = RawSignal(
                name, load, table.rows, time, unit=layout.units[column_index], table=table, key=key
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


def _layout(path: Path, signal_map: SignalMap) -> TextLayout:
    lines, skip, encoding, stated = _first_lines(path)
    delimiter = signal_map.delimiter or stated or _delimiter(path, lines)
    rows, ends = _rows(path, lines, delimiter)
    if not rows:
        raise DataError(f"'{path}' holds no rows; expected a header row and numbers")
    check_names(path, () if len(rows[0]) <= MOST_COLUMNS else map(str, range(len(rows[0]))))
    body = rows[1:] if signal_map.header else rows
    decimal = signal_map.decimal
    # With commas between cells, 1,5 is two cells.
    if decimal == "." and delimiter != "," and _has_decimal_commas(body):
        decimal = ","
    if signal_map.header:
        names, units, more = _header(path, rows, decimal)
        skip += ends[more - 1]
        body = rows[more:]
    else:
        names, units = _stated_columns(path, rows, signal_map)
    numeric = tuple(all(is_number(row[i], decimal) for row in body if i < len(row)) for i in range(len(names)))
    return TextLayout(names, units, numeric, delimiter, decimal, skip, encoding)


def _first_lines(path: Path) -> tuple[list[str], int, str, str | None]:
    """The lines behind leading comments, how many are before them, the encoding, and a delimiter that they state."""
    for size in _HEAD_BYTES:
        with path.open("rb") as stream:
            head = stream.read(size)
        encoding = _encoding(head)
        text = head.decode(encoding, errors="replace")
        # As the parser behind counts lines; other signs of Unicode end none.
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        whole = len(head) < size
        # The last line may be cut by the end of what was read.
        if not whole or not lines[-1]:
            lines.pop()
        skip, stated = 0, None
        while skip < len(lines) and (not lines[skip].strip() or lines[skip].lstrip()[0] in "#%"):
            skip += 1
        if skip < len(lines) and (match := _STATED.fullmatch(lines[skip])):
            # Excel writes the delimiter into the first line.
            stated, skip = match[1], skip + 1
        if whole or len(lines) > skip + 1:
            break
    if len(lines) <= skip:
        if not whole:
            raise DataError(f"'{path}': no row ends within the first {len(head)} bytes; it is no table")
        raise DataError(f"'{path}' holds no rows; expected a header row and numbers")
    return lines[skip:], skip, encoding, stated


def _rows(path: Path, lines: list[str], delimiter: str) -> tuple[list[list[str]], list[int]]:
    """The first rows that are not empty, and how many lines end with each.

    Raises:
        DataError: a cell too long.
    """
    reader = text_csv.reader((line + "\n" for line in lines), delimiter=delimiter)
    rows: list[list[str]] = []
    ends: list[int] = []
    cells = 0
    try:
        for row in reader:
            if row:
                rows.append(row)
                ends.append(reader.line_num)
                cells += len(row)
            if len(rows) >= _ROWS_LOOKED or (cells > _MOST_CELLS_LOOKED and len(rows) > 2):
                break
    except text_csv.Error as error:
        raise DataError(
            f"'{path}': line {reader.line_num} cannot be read ({error}); a cell has at most "
            f"{text_csv.field_size_limit()} characters: check the delimiter and the quotes"
        ) from error
    return rows, ends


def _encoding(head: bytes) -> str:
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        # Whole lines only: the end of what was read may cut a character.
        head[: head.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig" if head[:3] == b"\xef\xbb\xbf" else "utf-8"


def _delimiter(path: Path, lines: list[str]) -> str:
    """The delimiter that splits the first lines into the same, largest number of cells."""
    sample = [line for line in lines[:20] if line.strip()]
    best, most = ",", 0
    for delimiter in _DELIMITERS:
        try:
            counts = [len(row) for row in _rows(path, sample, delimiter)[0]] or [0]
        except DataError:
            # A line without this delimiter may be longer than a cell.
            continue
        # Four fifths, since comments and a row of units may stand among the first lines.
        if counts[0] > 1 and counts.count(counts[0]) >= 0.8 * len(counts) and counts[0] > most:
            best, most = delimiter, counts[0]
    return best


def _has_decimal_commas(rows: list[list[str]]) -> bool:
    cells = [cell.strip() for row in rows for cell in row]
    return any(re.fullmatch(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", cell) for cell in cells) and not any(
        re.fullmatch(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?", cell) for cell in cells
    )


def _header(path: Path, rows: list[list[str]], decimal: str) -> tuple[tuple[str, ...], tuple[str | None, ...], int]:
    """Names, units and the number of header rows (2 with a row of units)."""
    # A name may be broken into lines where it is quoted.
    cells = [" ".join(cell.split()) for cell in rows[0]]
    filled = [cell for cell in cells if cell]
    if not filled or all(is_number(cell, decimal) for cell in filled):
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
    # Round brackets may belong to the name, as in "speed (filtered)".
    return (match["name"], unit) if unit in UNITS or unit in TIME_UNITS else (cell, None)


def _is_unit_row(row: list[str], decimal: str) -> bool:
    cells = [cell.strip().strip("[]()") for cell in row]
    filled = [cell for cell in cells if cell]
    # 1 is a number and the unit of a ratio: by itself it decides nothing.
    words = [cell for cell in filled if cell != "1"]
    is_unit = [normalise_unit(cell) in UNITS or normalise_unit(cell) in TIME_UNITS for cell in words]
    return any(is_unit) and not any(is_number(cell, decimal) for cell in words)


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


def _ambiguous(path: Path, name: str, samples: int, time: Column | None) -> RawSignal:
    def load() -> Column:
        raise DataError(f"'{path}' has two columns named '{name}'; rename one of them")

    return RawSignal(name, load, samples, time)


def _stamps(table: CsvTable, column_index: int, signal_map: SignalMap) -> Column:
    layout = table.layout
    name, unit = layout.names[column_index], layout.units[column_index]
    if table.types[table.keys[column_index]] != pa.string():
        return load_column(table, str(column_index), table.rows) * time_factor(name, unit, signal_map)
    cells = [(cell or "NaT").strip().removesuffix("Z") for cell in table.texts(column_index)]
    try:
        dates = np.array(cells, dtype="datetime64[ns]")
    except ValueError:
        table.refuse_text(column_index)
        raise
    if not len(dates):
        return np.empty(0)
    stamps = (dates - dates[0]) / np.timedelta64(1, "s")
    return np.asarray(stamps, dtype=np.float64)
