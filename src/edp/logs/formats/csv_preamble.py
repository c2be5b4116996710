"""Detection of the first table row in a text file, below lines that a logger writes about itself."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_SAME_WIDTH = 0.8
"""Minimum fraction of later rows with an equal number of cells. Otherwise the file is damaged, or is not a table."""
_NUMBERS = 0.8
"""Minimum fraction of numbers among the filled cells of a numeric column."""
_MAX_HEADER_ROWS = 4
"""Maximum number of header rows from the names to the numbers: names, units and descriptions."""
_MAX_REMARKS = 2
"""Maximum number of named remark columns after the numeric columns."""
_WORDS = 3
"""Minimum number of words in a cell of a row with descriptions instead of names."""
_NAME = re.compile(r"[^\s]{1,48}(?: [^\s]+)?")
"""Pattern of a possible name: one word, or two as in ``speed [mm/s]``."""


@dataclass(frozen=True)
class TablePlace:
    """Rows of a text file, counted from 0 among those that are not empty.

    Attributes:
        header: the row of names; that of `first` where there is none.
        first: the first row of numbers.
        padding: cells that the row of names lacks at its end, where the rows of numbers end with a delimiter; below
            zero those that it has beside the numbers, of remarks that hardly any row has.
    """

    header: int
    first: int
    padding: int = 0


def find_table(
    rows: Sequence[Sequence[str]], is_number: Callable[[str], bool], is_unit_row: Callable[[list[str]], bool]
) -> TablePlace | None:
    """Return the position of the table below lines of another kind; None if the table begins with the first row.

    Args:
        rows: the first rows, cells as text.
        is_number: whether a cell holds a number or nothing.
        is_unit_row: whether a row holds units.
    """
    tail = rows[len(rows) // 2 :]
    width, count = Counter(len(row) for row in tail).most_common(1)[0]
    if width < 2 or count < _SAME_WIDTH * len(tail):
        return None
    if _runs_on(rows[0], width, is_number):
        return TablePlace(0, 1, -width)
    whole = [row for row in tail if len(row) == width]
    columns = [i for i in range(width) if _is_numeric([row[i] for row in whole], is_number)]
    first = next((i for i, row in enumerate(rows) if _is_data(row, width, columns, is_number)), None)
    if not columns or first is None:
        return None
    top = first
    while top > 0 and _may_name(rows[top - 1], width, whole, is_number):
        top -= 1
    if top == first:
        # Rows of text and numbers in turn are not left out silently: the first row stays the header.
        mixed = any(_may_name(row, width, whole, is_number) for row in rows[:first])
        return TablePlace(first, first) if first and not mixed else None
    header = _header_of(rows, top, first, is_unit_row)
    usual = header == 0 and (first == 1 or (first == 2 and is_unit_row(list(rows[1]))))
    padding = width - len(rows[header])
    return None if (usual and not padding) or first - header > _MAX_HEADER_ROWS else TablePlace(header, first, padding)


def _runs_on(row: Sequence[str], width: int, is_number: Callable[[str], bool]) -> bool:
    """Return whether a missing line end puts names and first values on one line."""
    names, numbers = row[:width], row[width:]
    return (
        len(numbers) == width
        and all(cell.strip() and not is_number(cell) for cell in names)
        and all(cell.strip() and is_number(cell) for cell in numbers)
    )


def _is_numeric(cells: list[str], is_number: Callable[[str], bool]) -> bool:
    filled = [cell for cell in cells if cell.strip()]
    return bool(filled) and sum(map(is_number, filled)) >= _NUMBERS * len(filled)


def _is_data(row: Sequence[str], width: int, columns: list[int], is_number: Callable[[str], bool]) -> bool:
    """Return whether most cells in the numeric columns of a row are numeric. Text may replace missing values."""
    if not width <= len(row) <= width + _MAX_REMARKS or any(map(is_number, row[width:])):
        return False
    filled = [row[i] for i in columns if row[i].strip()]
    return 2 * len(filled) >= len(columns) and 2 * sum(map(is_number, filled)) > len(filled)


def _may_name(row: Sequence[str], width: int, whole: Sequence[Sequence[str]], is_number: Callable[[str], bool]) -> bool:
    """Return whether a row may contain names, units or descriptions: half of its cells filled, without values."""
    ends_open = len(row) == width - 1 and not any(other[-1].strip() for other in whole)
    if width < len(row) <= width + _MAX_REMARKS:
        row = row[:width]
    filled = [cell for cell in row if cell.strip()]
    # 1 is the unit of a ratio, too.
    return (
        (len(row) == width or ends_open)
        and 2 * len(filled) > width - ends_open
        and not any(is_number(cell) and cell.strip().strip("[]()") != "1" for cell in filled)
    )


def _header_of(rows: Sequence[Sequence[str]], top: int, first: int, is_unit_row: Callable[[list[str]], bool]) -> int:
    """Return the row with the column names: the lowest row above the values without units or descriptions."""
    # A row of names may pass for one of units: t, V and A are both.
    named = [top, *(row for row in range(top + 1, first) if not is_unit_row(list(rows[row])))]
    lowest = named[-1]
    describes = any(len(cell.split()) >= _WORDS for cell in rows[lowest])
    if describes and len(named) > 1:
        above = [cell.strip() for cell in rows[lowest - 1]]
        # Letters as t, V and A may be names; longer units are none.
        units_above = is_unit_row(above) and any(len(cell) > 1 for cell in above)
        if not units_above and len(set(above)) == len(above) and all(_NAME.fullmatch(cell) for cell in above):
            return lowest - 1
    return lowest
