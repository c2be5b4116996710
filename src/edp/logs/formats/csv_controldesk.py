"""Text exports of dSPACE ControlDesk: keyed header rows about the recording and its traces above the values.

The first cell of a row of the head is its key; rows of numbers have none, but the first. A trace without a name and
a path is the time, in seconds, of the traces behind it; each raster has one, and slower rasters end in earlier rows.
Traces are often named by the port that they were taken from (``In1``): then the block in their path tells them apart.
"""

from __future__ import annotations

import csv as text_csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from edp.errors import DataError, brief
from edp.logs.formats.base import Column, RawLog, RawSignal, load_column
from edp.logs.formats.csv_table import CsvTable, TextLayout, has_decimal_commas
from edp.logs.units import normalise_unit

_NAMES, _UNITS, _PATHS, _VALUES = "trace_names", "trace_units", "path", "trace_values"
_MAX_HEAD_ROWS = 200
_LONGEST_HEAD = 1 << 26
"""Maximum number of characters above the numeric rows."""
_SAMPLE_ROWS = 20
"""Number of numeric rows examined to detect the decimal sign."""
_PORT = re.compile(r"(In|Out|Value)\d*")
"""Pattern of port names, which do not describe the signal."""


@dataclass(frozen=True)
class ControlDeskHead:
    """The head of an export.

    Attributes:
        names: names of the cells of a row; empty for the key and for time.
        units: units of the cells.
        paths: model paths of the cells; empty without a path.
        times: places of the columns of time.
        repeated: names that several traces have in the file, with the names that tell them apart.
        delimiter: between cells.
        decimal: sign.
        lines: before the first row of numbers.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    paths: tuple[str, ...]
    times: tuple[int, ...]
    repeated: Mapping[str, Sequence[str]]
    delimiter: str
    decimal: str
    lines: int


def controldesk_head(path: Path, lines: Sequence[str], encoding: str) -> ControlDeskHead | None:
    """Return the head of a ControlDesk export; None for any other text.

    Args:
        path: the file.
        lines: the first lines of it.
        encoding: encoding of the text.

    Raises:
        DataError: the head has no rows of numbers behind it, or no time.
    """
    named = next((line for line in lines[:_MAX_HEAD_ROWS] if line.startswith(_NAMES)), "")
    delimiter = named[len(_NAMES) : len(_NAMES) + 1]
    if delimiter not in (",", ";", "\t", "|"):
        return None
    rows, sample, used = _rows_of_head(path, encoding, delimiter)
    width = len(rows[_NAMES])
    cells = {key: [cell.strip() for cell in [*row, *[""] * width][:width]] for key, row in rows.items()}
    names, paths = cells[_NAMES], cells.get(_PATHS, [""] * width)
    times = tuple(i for i in range(1, width) if not paths[i] and names[i].lower() in ("", "time"))
    if not times or times[0] != 1:
        raise DataError(
            f"'{path}': this export of ControlDesk has no column of time before its traces; export it again"
        )
    told_apart = _make_names_unique(names, paths, times)
    repeated: dict[str, list[str]] = {}
    for i, name in enumerate(names):
        if told_apart[i] and name and names.count(name) > 1:
            repeated.setdefault(name, []).append(told_apart[i])
    units = tuple(normalise_unit(cell) for cell in cells.get(_UNITS, [""] * width))
    decimal = "," if has_decimal_commas(sample, delimiter) else "."
    return ControlDeskHead(told_apart, units, tuple(paths), times, repeated, delimiter, decimal, used)


def _rows_of_head(path: Path, encoding: str, delimiter: str) -> tuple[dict[str, list[str]], list[list[str]], int]:
    """Return the header rows by key, some numeric rows, and the number of lines before them.

    Raises:
        DataError: the head does not end, or cannot be read.
    """
    rows: dict[str, list[str]] = {}
    sample: list[list[str]] = []
    used = characters = 0
    with path.open(encoding=encoding, errors="replace", newline="") as stream:
        reader = text_csv.reader(stream, delimiter=delimiter)
        try:
            for row in reader:
                characters += sum(map(len, row))
                if sample or row[:1] == [_VALUES]:
                    sample.append(row[1:])
                else:
                    used = reader.line_num
                    rows.setdefault(row[0] if row else "", row)
                ends = len(sample) >= _SAMPLE_ROWS
                if ends or characters > _LONGEST_HEAD or (not sample and used > _MAX_HEAD_ROWS):
                    break
        except text_csv.Error as error:
            raise DataError(
                f"'{path}': line {reader.line_num} of this export of ControlDesk cannot be read ({brief(error)}); "
                "export it again"
            ) from error
    if not sample or _NAMES not in rows:
        raise DataError(
            f"'{path}': this export of ControlDesk has no row '{_VALUES}' within its first lines: it holds no numbers; "
            "record longer, or export it again"
        )
    return rows, sample, used


def _make_names_unique(names: Sequence[str], paths: Sequence[str], times: Sequence[int]) -> tuple[str, ...]:
    """Return unique column names: the trace name, or the block name in its path if the trace name is ambiguous."""
    shared = Counter(names)
    blocks = [
        path.rstrip("/").rpartition("/")[2] or name if shared[name] > 1 or _PORT.fullmatch(name) or not name else name
        for name, path in zip(names, paths)
    ]
    traces = {i for i in range(len(names)) if i and i not in times}
    used = Counter(blocks[i] for i in traces)
    return tuple(
        "" if i not in traces else name if name and used[name] == 1 else f"{name or 'trace'}.{i + 1}"
        for i, name in enumerate(blocks)
    )


def read_controldesk(path: Path, head: ControlDeskHead, encoding: str) -> RawLog:
    """Read an export whose head is known.

    Args:
        path: the file.
        head: head of the export.
        encoding: encoding of the text.

    Raises:
        DataError: rows of another width than the head, or a time that is no number.
    """
    numeric = tuple(i > 0 for i in range(len(head.names)))
    layout = TextLayout(head.names, head.units, numeric, head.delimiter, head.decimal, head.lines, encoding)
    table = CsvTable(path, layout)
    for time_index in head.times:
        if table.types[table.keys[time_index]] == pa.string():
            table.refuse_text(time_index)
    signals: dict[str, RawSignal] = {}
    time: Column = np.empty(0)
    for i, name in enumerate(head.names):
        if i in head.times:
            stamps = load_column(table, str(i), table.rows)
            time = stamps[np.isfinite(stamps)]
        if not name:
            continue
        load = partial(load_column, table, str(i), table.rows)
        if len(time) == table.rows:
            signals[name] = RawSignal(name, load, table.rows, time, head.units[i], None, head.paths[i], table, str(i))
        else:
            values = load()[: len(time)]
            signals[name] = RawSignal(name, partial(np.asarray, values), len(values), time, head.units[i])
    aliases = {
        head.paths[i]: name for i, name in enumerate(head.names) if name and head.paths.count(head.paths[i]) == 1
    }
    aliases = {full: name for full, name in aliases.items() if full and full not in signals}
    repeated = {name: full for name, full in head.repeated.items() if name not in signals}
    return RawLog(path, signals, aliases=aliases, repeated=repeated)
