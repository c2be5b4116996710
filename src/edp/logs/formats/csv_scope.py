"""Text exports of TwinCAT Scope: header rows with channel data, and one time column per group of channels.

Every row of the head begins with its key, which stands again above each time column. Times count in milliseconds from
the start of the export, groups may have rates of their own, and rows end where slower channels have no more samples.
"""

from __future__ import annotations

import csv as text_csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, brief
from edp.logs.formats.base import Column, RawLog, RawSignal
from edp.logs.formats.csv_table import NULLS
from edp.logs.units import normalise_unit
from edp.storage.memory import free_bytes

_STEP_KEY = "SampleTime[ms]"
_NAME_KEY, _UNIT_KEY = "Name", "Unit"
_MAX_HEAD_LINES = 60
_END = "EOF"
_WIDEST = 6
"""Memory in bytes per byte of text: eight-byte numbers and the parser's own copies."""
_SHARE = 0.5
"""Maximum fraction of free memory for a file."""


@dataclass(frozen=True)
class ScopeHead:
    """The head of an export.

    Attributes:
        names: names of the cells of a row; `SampleTime[ms]` for time.
        units: units of the cells.
        delimiter: between cells.
        lines: before the first row of numbers.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    delimiter: str
    lines: int


def scope_head(path: Path, lines: Sequence[str]) -> ScopeHead | None:
    """Return the head of a TwinCAT Scope export; None for any other text.

    Args:
        path: the file.
        lines: the first lines of it.

    Raises:
        DataError: its delimiter stands within cells, too.
    """
    steps = next((i for i, line in enumerate(lines[:_MAX_HEAD_LINES]) if line.lstrip('"').startswith(_STEP_KEY)), None)
    if steps is None or not lines[0].lstrip('"').startswith(_NAME_KEY):
        return None
    behind = lines[steps].lstrip('"')[len(_STEP_KEY) :].lstrip('"')
    delimiter = behind[:1]
    if not delimiter or delimiter.isalnum():
        return None
    first = steps
    while first > 0 and lines[first - 1].strip():
        first -= 1
    last = steps
    while last < len(lines) and lines[last].strip():
        last += 1
    rows = {row[0]: row for row in text_csv.reader(lines[first:last], delimiter=delimiter) if row}
    if _NAME_KEY not in rows:
        return None
    # A delimiter may end the rows of the head only.
    width = len(rows[_STEP_KEY]) - (not rows[_STEP_KEY][-1].strip())
    if any(row[key_place] != key for key, row in rows.items() for key_place in _time_places(rows[_STEP_KEY], len(row))):
        raise DataError(
            f"'{path}': the delimiter {delimiter!r} of this export of TwinCAT Scope stands within names or numbers, "
            "too; export it with a tab or a semicolon"
        )
    cells = {key: [*row, *[""] * width][:width] for key, row in rows.items()}
    times = [cell == _STEP_KEY for cell in cells[_STEP_KEY]]
    names = tuple(_STEP_KEY if time else name.strip() for time, name in zip(times, cells[_NAME_KEY]))
    units = tuple(map(_unit, cells.get(_UNIT_KEY, [""] * width)))
    while last < len(lines) and not lines[last].strip():
        last += 1
    return ScopeHead(names, units, delimiter, last)


def _time_places(steps: Sequence[str], width: int) -> list[int]:
    """Return the places of time columns that a row of some cells reaches."""
    return [index for index, cell in enumerate(steps[:width]) if cell == _STEP_KEY]


def _unit(cell: str) -> str | None:
    """Return the unit of a cell: ``V (Voltage)`` is V, ``(None)`` has no unit."""
    return normalise_unit(cell.partition("(")[0])


def read_scope(path: Path, head: ScopeHead, sample: Sequence[str], encoding: str) -> RawLog:
    """Read an export whose head is known.

    Args:
        path: the file.
        head: head of the export.
        sample: some of its rows of numbers.
        encoding: encoding of the text.

    Raises:
        DataError: cells that are no numbers, or more of them than the free memory holds.
    """
    size = path.stat().st_size
    if _WIDEST * size > _SHARE * free_bytes():
        raise DataError(
            f"'{path}': an export of TwinCAT Scope of {size / 1e6:,.0f} MB does not fit into the free memory; export "
            "fewer channels or a shorter time"
        )
    comma = head.delimiter != "," and any("," in line for line in sample)
    values = _numbers(path, head, "," if comma else ".", encoding)
    signals: dict[str, RawSignal] = {}
    time: Column | None = None
    for index, name in enumerate(head.names):
        column = values[:, index]
        if name == _STEP_KEY:
            time = column[np.isfinite(column)] * 1e-3
            continue
        if time is None or not len(time):
            raise DataError(f"'{path}': column '{name[:60]}' has no time stamps beside it; export it again")
        part = np.ascontiguousarray(column[: len(time)])
        full = name if name and name not in signals else f"{name or 'column'}.{index + 1}"
        signals[full] = RawSignal(full, partial(np.asarray, part), len(part), time, unit=head.units[index])
    return RawLog(path, signals)


def _numbers(path: Path, head: ScopeHead, decimal: str, encoding: str) -> NDArray[np.float64]:
    """Return all cells below the head, shape ``(row, cell)``, NaN where a row ends before."""
    import pandas as pd

    rows = _count_rows(path, head, encoding)
    try:
        frame = pd.read_csv(
            path,
            sep=head.delimiter,
            decimal=decimal,
            header=None,
            names=list(range(len(head.names))),
            skiprows=head.lines,
            nrows=rows,
            usecols=range(len(head.names)),
            na_values=[*NULLS, " "],
            dtype=np.float64,
            encoding=encoding,
        )
    except (ValueError, OSError) as error:
        raise DataError(
            f"'{path}': a row below the head of this export of TwinCAT Scope holds something else than numbers "
            f"({brief(error)}); export it again"
        ) from error
    return np.asarray(frame.to_numpy(), dtype=np.float64)


def _count_rows(path: Path, head: ScopeHead, encoding: str) -> int:
    """Count the numeric rows: lines that are not empty, without the end-of-file marker.

    Raises:
        DataError: a row with more cells than the head.
    """
    count = 0
    with path.open(encoding=encoding, errors="replace") as stream:
        for line_number, line in enumerate(stream):
            text = line.strip(" \n\r")
            if line_number < head.lines or not text.strip() or text == _END:
                continue
            if text.rstrip(head.delimiter).count(head.delimiter) >= len(head.names):
                raise DataError(
                    f"'{path}': line {line_number + 1} of this export of TwinCAT Scope has more cells than its head; "
                    "export it again"
                )
            count += 1
    return count
