"""CSV: any delimiter, decimal comma, units in the header or in a row of their own, or no header at all."""

from __future__ import annotations

import csv as text_csv
import io
import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as arrow_csv

from edp.errors import DataError
from edp.logs.formats.base import (
    FORMATS,
    MAX_COLUMNS,
    Column,
    RawLog,
    RawSignal,
    WriteOptions,
    check_names,
    find_time,
    load_column,
    time_factor,
)
from edp.logs.formats.csv_controldesk import controldesk_head, read_controldesk
from edp.logs.formats.csv_dates import dates_of, is_date
from edp.logs.formats.csv_encoding import encoding_of
from edp.logs.formats.csv_messages import drop_empty_rows, message_columns
from edp.logs.formats.csv_preamble import TablePlace, find_table
from edp.logs.formats.csv_scope import read_scope, scope_head
from edp.logs.formats.csv_table import CsvTable, TextLayout, has_decimal_commas, is_grouped, is_number
from edp.logs.units import OTHER_UNITS, normalise_unit
from edp.recording import Recording
from edp.signals import TIME_UNITS, UNITS, SignalMap

_HEAD_BYTES = (1 << 18, 1 << 22, 1 << 26)
"""Sizes of the examined head of a file. Longer comments or headers need the larger ones."""
_MAX_CELLS_LOOKED = 200_000
"""Maximum number of cells examined to detect the layout. Wide tables need fewer rows."""
_DELIMITERS = (",", ";", "\t", "|")
"""Supported delimiters. If several fit equally well, the first one is used."""
_BLANKS = " "
"""Delimiter of columns separated by any number of blanks, used if no other delimiter gives columns."""
_NAME_UNIT = re.compile(r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\))$")
_BRACKETS = re.compile(r"[\[(]([^\])]{1,12})[\])]")
NAME_BY_PLACE = re.compile(r"column_\d+")
"""Pattern of the generated column names for a file without names."""
_STATED = re.compile(r'sep=([^\w\s"]|\t)', re.IGNORECASE)
_ROWS_LOOKED = 200
"""Number of rows examined to detect the layout."""
_BLOCK_ROWS = 65536
"""Rows written at a time, so that no second copy of the recording is made."""


class CsvFormat:
    """Text separated by commas, semicolons, tabs, bars or blanks."""

    name = "csv"
    suffixes: tuple[str, ...] = (".csv", ".tsv", ".txt", ".dat")
    content = "CSV text"
    libraries = ("pandas",)  # which pyarrow imports when columns become arrays

    def claims(self, head: bytes) -> bool:
        """Return text without NUL bytes, or UTF-16 with its mark."""
        if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return True
        printable = sum(byte >= 32 or byte in b"\t\r\n\f" for byte in head)
        return bool(head) and b"\0" not in head and printable == len(head)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read a text file; empty cells are missing values."""
        lines, _, encoding, *_ = _first_lines(path)
        if (head := scope_head(path, lines)) is not None:
            return read_scope(path, head, lines[head.lines :], encoding)
        if (desk := controldesk_head(path, lines, encoding)) is not None:
            return read_controldesk(path, desk, encoding)
        layout = _layout(path, signal_map)
        table = CsvTable(path, layout)
        names = [name for name in layout.names if name]
        time_name = find_time(names, signal_map, path)
        time = None if time_name is None else _stamps(table, layout.names.index(time_name), signal_map)
        signals: dict[str, RawSignal] = {}
        sparse = set() if time is None else message_columns(table)
        repeated: dict[str, list[str]] = {}
        times_named = Counter(layout.names)
        for column_index, shared_name in enumerate(layout.names):
            if not shared_name or shared_name == time_name:
                continue
            name = shared_name
            if times_named[shared_name] > 1:
                name = f"column_{column_index + 1}.{shared_name}"
                repeated.setdefault(shared_name, []).append(name)
            if column_index in sparse and time is not None:
                signals[name] = drop_empty_rows(table, column_index, name, time)
                continue
            key = str(column_index)
            load = partial(load_column, table, key, table.rows)
            signals[name] = RawSignal(
                name, load, table.rows, time, unit=layout.units[column_index], table=table, key=key
            )
        return RawLog(path, signals, repeated=repeated, meta=table.facts)

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write ``time_s`` and every channel as ``name [unit]``. Values are read back bit for bit."""
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
    lines, skip, encoding, stated, remark = _first_lines(path)
    delimiter = signal_map.delimiter or stated or _delimiter(path, lines)
    rows, ends = _rows(path, lines, delimiter)
    if not rows:
        raise DataError(f"'{path}' holds no rows; expected a header row and numbers")
    check_names(path, () if len(rows[0]) <= MAX_COLUMNS else map(str, range(len(rows[0]))))
    table_place = find_table(rows, _number_of_any_kind(delimiter), _is_unit_row) or TablePlace(0, 0)
    named = table_place.header < table_place.first
    padding = table_place.padding
    rows[table_place.header] = [*rows[table_place.header], *[""] * padding][: padding if padding < 0 else None]
    head = rows[table_place.header]
    body = rows[table_place.first :] if named else rows[table_place.header + signal_map.header :]
    decimal = signal_map.decimal
    if decimal == "." and has_decimal_commas(body, delimiter):
        decimal = ","
    if not signal_map.header:
        body = rows[table_place.first :]
        names, units = _read_mapped_columns(path, body, signal_map)
        used = table_place.first
    elif _holds_numbers_only(head, decimal):
        names, units, used = (
            *_names_beside(path, rows[table_place.header :], remark, delimiter, signal_map),
            table_place.header,
        )
        body = rows[used:]
    else:
        names, units, more = _header(rows[table_place.header :])
        used = table_place.first if named else table_place.header + more
        if named:
            units = _units_above(rows[: table_place.header], _units_between(rows[table_place.header + 1 : used], units))
        body = rows[used:]
    skip += ends[used - 1] if used else 0
    # A logger that was restarted writes its names anew.
    names_again = [cell.strip() for cell in head]
    body = [row for row in body if [cell.strip() for cell in row] != names_again]
    numeric = tuple(all(is_number(row[i], decimal) for row in body if i < len(row)) for i in range(len(names)))
    return TextLayout(names, units, numeric, delimiter, decimal, skip, encoding)


def _number_of_any_kind(delimiter: str) -> Callable[[str], bool]:
    """Return a function that tests whether a cell is a number with any decimal sign, before that sign is known."""

    def is_some_number(cell: str) -> bool:
        return is_number(cell) or is_number(cell, ",") or is_grouped(cell.strip())

    return is_some_number


def _holds_numbers_only(head: list[str], decimal: str) -> bool:
    """Return whether a row contains only numbers and dates, and therefore no names."""
    filled = [cell for cell in head if cell.strip()]
    others = [cell for cell in filled if not is_number(cell, decimal)]
    return len(others) < max(len(filled), 1) and all(map(is_date, others))


def _names_beside(
    path: Path, rows: list[list[str]], remark: str, delimiter: str, signal_map: SignalMap
) -> tuple[tuple[str, ...], tuple[str | None, ...]]:
    """Return column names for a table without a header row: from the comment above the values, or numbered.

    Raises:
        DataError: neither.
    """
    width = len(rows[0])
    text = remark.strip().lstrip("#%").strip()
    # Tools that write a header as a comment often part its names by blanks.
    for cells in (_rows(path, [text], delimiter)[0][:1], [text.split()]):
        cells = [[cell.strip() for cell in row] for row in cells]
        if cells and len(cells[0]) == width and all(cells[0]) and not any(map(is_number, cells[0])):
            pairs = [_name_and_unit(cell) for cell in cells[0]]
            return tuple(name for name, _ in pairs), tuple(unit for _, unit in pairs)
    if signal_map.others and not signal_map.channels:
        return tuple(f"column_{i + 1}" for i in range(width)), (None,) * width
    shown = ", ".join(cell[:20] for cell in rows[0][:4])
    raise DataError(
        f"'{path}': the first row holds numbers, not names ({shown}); set header = false in the signal map (--map) "
        "and list its columns, or let `edp init` write one"
    )


def _units_between(rows: list[list[str]], units: tuple[str | None, ...]) -> tuple[str | None, ...]:
    """Return the units from a row of them below the names, where there is one; else as the names state them."""
    for row in rows:
        if _is_unit_row(row):
            cells = [normalise_unit(cell.strip().strip("[]()")) for cell in row]
            return tuple(cells[i] or unit if i < len(cells) else unit for i, unit in enumerate(units))
    return units


def _units_above(rows: list[list[str]], units: tuple[str | None, ...]) -> tuple[str | None, ...]:
    """Return the units from the row above the names, which some loggers write there; only where no name states any."""
    if not rows or any(units) or len(rows[-1]) != len(units):
        return units
    cells = [normalise_unit(cell.strip().strip("[]()")) for cell in rows[-1]]
    unit_cells = [cell for cell in cells if cell in UNITS or cell in TIME_UNITS or cell in OTHER_UNITS]
    # One word that is a unit may be a name, as V and A are.
    return tuple(cells) if 2 * len(unit_cells) > len(units) else units


def _first_lines(path: Path) -> tuple[list[str], int, str, str | None, str]:
    """Return the lines after leading comments, the count before them, encoding, stated delimiter and last comment."""
    for size in _HEAD_BYTES:
        with path.open("rb") as stream:
            head = stream.read(size)
        encoding = encoding_of(head)
        text = head.decode(encoding, errors="replace")
        # As the parser behind counts lines; other signs of Unicode end none.
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        whole = len(head) < size
        # The last line may be cut by the end of what was read.
        if not whole or not lines[-1]:
            lines.pop()
        skip, stated, remark = 0, None, ""
        while skip < len(lines) and (not lines[skip].strip() or lines[skip].lstrip()[0] in "#%"):
            remark = lines[skip] or remark
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
    return lines[skip:], skip, encoding, stated, remark


def _rows(path: Path, lines: list[str], delimiter: str) -> tuple[list[list[str]], list[int]]:
    """Return the first rows that are not empty, and the number of lines up to each.

    Raises:
        DataError: a cell too long.
    """
    if delimiter == _BLANKS:
        lines = [" ".join(line.split()) for line in lines]
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
            if len(rows) >= _ROWS_LOOKED or (cells > _MAX_CELLS_LOOKED and len(rows) > 2):
                break
    except text_csv.Error as error:
        raise DataError(
            f"'{path}': line {reader.line_num} cannot be read ({error}); a cell has at most "
            f"{text_csv.field_size_limit()} characters: check the delimiter and the quotes"
        ) from error
    return rows, ends


def _delimiter(path: Path, lines: list[str]) -> str:
    """Return the delimiter that splits the first lines into the same, largest number of cells."""
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
    return best if most else _delimiter_of_numbers(path, lines)


def _delimiter_of_numbers(path: Path, lines: list[str]) -> str:
    """Return the delimiter that splits the later of the first lines into numeric cells."""
    filled = [line for line in lines[:_ROWS_LOOKED] if line.strip()]
    tail = filled[len(filled) // 2 :]
    best, best_score = ",", (0.0, 0)
    for delimiter in _DELIMITERS:
        try:
            rows = _rows(path, tail, delimiter)[0]
        except DataError:
            continue
        width, count = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        if width < 2 or count < 0.8 * len(rows):
            continue
        is_some_number = _number_of_any_kind(delimiter)
        cells = [cell for row in rows for cell in row]
        score = (round(sum(map(is_some_number, cells)) / len(cells), 2), width)
        if score > best_score:
            best, best_score = delimiter, score
    return _BLANKS if best_score == (0.0, 0) and _is_separated_by_blanks(tail) else best


def _is_separated_by_blanks(lines: list[str]) -> bool:
    """Return whether each line has the same number of numeric cells, two or more, separated by blanks."""
    rows = [line.split() for line in lines]
    widths = {len(row) for row in rows}
    return len(widths) == 1 and max(widths) > 1 and all(is_number(cell) for row in rows for cell in row)


def _header(rows: list[list[str]]) -> tuple[tuple[str, ...], tuple[str | None, ...], int]:
    """Return the names, units and the number of header rows (2 with a row of units)."""
    # A name may be broken into lines where it is quoted.
    pairs = [_name_and_unit(" ".join(cell.split())) for cell in rows[0]]
    names, units = tuple(name for name, _ in pairs), tuple(unit for _, unit in pairs)
    if len(rows) > 1 and _is_unit_row(rows[1]):
        return names, _units_between(rows[1:2], units), 2
    return names, units, 1


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    match = _NAME_UNIT.match(cell)
    if match is None:
        # "Flow (GPM) - Plot 0": what stands behind a unit tells columns apart.
        within = [normalise_unit(text) for text in _BRACKETS.findall(cell)]
        return cell, next((unit for unit in within if unit in UNITS or unit in TIME_UNITS or unit in OTHER_UNITS), None)
    if match["square"] is not None:
        return match["name"], normalise_unit(match["square"])
    unit = normalise_unit(match["round"])
    # Round brackets may belong to the name, as in "speed (filtered)".
    is_unit = unit in UNITS or unit in TIME_UNITS or unit in OTHER_UNITS
    return (match["name"], unit) if is_unit else (cell, None)


def _is_unit_row(row: list[str]) -> bool:
    cells = [cell.strip().strip("[]()") for cell in row]
    filled = [cell for cell in cells if cell]
    # 1 is a number and the unit of a ratio: by itself it decides nothing.
    words = [cell for cell in filled if cell != "1"]
    is_unit = [normalise_unit(cell) in UNITS or normalise_unit(cell) in TIME_UNITS for cell in words]
    return any(is_unit) and not any(is_number(cell) or is_number(cell, ",") for cell in words)


def _read_mapped_columns(
    path: Path, rows: list[list[str]], signal_map: SignalMap
) -> tuple[tuple[str, ...], tuple[str | None, ...]]:
    width = len(rows[0])
    if len(signal_map.columns) != width:
        raise DataError(
            f"'{path}' has {width} columns per row and no header; 'columns' of the signal map names "
            f"{len(signal_map.columns)}: name all {width} in order"
        )
    return tuple(signal_map.columns), (None,) * width


def _stamps(table: CsvTable, column_index: int, signal_map: SignalMap) -> Column:
    layout = table.layout
    name, unit = layout.names[column_index], layout.units[column_index]
    if table.types[table.keys[column_index]] != pa.string():
        return load_column(table, str(column_index), table.rows) * time_factor(name, unit, signal_map)
    cells = table.texts(column_index)
    numbers = table.parse_grouped_numbers(column_index)
    if numbers is not None:
        return numbers * time_factor(name, unit, signal_map)
    try:
        dates = dates_of(cells)
    except ValueError:
        table.refuse_text(column_index)
        raise
    if not len(dates):
        return np.empty(0)
    stamps = (dates - dates[0]) / np.timedelta64(1, "s")
    return np.asarray(stamps, dtype=np.float64)
