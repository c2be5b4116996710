"""Tables of results: one class that pages, notebooks, documents, CSV files and the terminal show."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from edp.wording import MISSING, decimals_for, escape_csv, escape_markdown, number, unit_text

Value = float | int | str | None
Show = Callable[[Value], str]


def plainly(value: Value) -> str:
    """Return a value as text, a dash for None and for empty text."""
    return MISSING if value is None or value == "" else str(value)


def figures(values: Iterable[Value], signed: bool = False, decimals: int | None = None) -> Show:
    """Return a function that formats the values of a column with a common precision.

    Args:
        values: the column, whose smallest number sets the decimals.
        signed: whether positive numbers have a sign.
        decimals: fixed decimals instead.
    """
    numbers = [value for value in values if isinstance(value, int | float)]
    places = decimals_for(numbers) if decimals is None else decimals

    def show(value: Value) -> str:
        return number(value, places, signed) if isinstance(value, int | float) else plainly(value)

    return show


def chance(value: Value) -> str:
    """Return a p-value with three decimals; values close to zero or one are shown as a bound."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return plainly(value if isinstance(value, str) else None)
    # A p-value of zero or one would claim certainty that no test has.
    return "< 0.001" if value < 0.0005 else "> 0.999" if 0.9995 < value < 1 else f"{value:.3f}"


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        heading: without the unit.
        unit: of all values.
        show: returns a value as text.
        is_text: whether values are words, which are aligned left and wrapped, and not figures.
    """

    heading: str
    unit: str = ""
    show: Show = plainly
    is_text: bool = False

    def head(self) -> str:
        """Return the heading with its unit in brackets."""
        unit = unit_text(self.unit)
        return f"{self.heading} [{unit}]" if unit else self.heading


@dataclass(frozen=True)
class Table:
    """Rows of values under columns; the first column is the name of the row.

    Attributes:
        caption: above the table.
        columns: one for each value of a row.
        rows: values; None where there is none.
        marked: places of rows that stand out.
        name: of the table's files.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]
    marked: frozenset[int] = frozenset()
    name: str = ""

    def heads(self) -> list[str]:
        """Return the headings, each with its unit."""
        return [column.head() for column in self.columns]

    def texts(self) -> tuple[tuple[str, ...], ...]:
        """Return the cells as a reader sees them."""
        return tuple(tuple(column.show(value) for column, value in zip(self.columns, row)) for row in self.rows)

    def drop_empty_columns(self) -> Table:
        """Return the table without columns that are empty in every row, such as pressures of a machine without them."""
        texts = self.texts()
        filled = [i for i in range(len(self.columns)) if not i or any(row[i] != MISSING for row in texts)]
        if not self.rows or len(filled) == len(self.columns):
            return self
        rows = tuple(tuple(row[i] for i in filled) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in filled), rows=rows)

    def markdown(self) -> str:
        """Return the caption and the table as Markdown; marked rows are bold."""
        heads = [_escape_cell(head) for head in self.heads()]
        lines = [f"**{_escape_cell(self.caption)}**", "", _row(heads), _row(["---"] * len(heads))]
        for row, cells in enumerate(self.texts()):
            bold = row in self.marked
            lines.append(_row([f"**{_escape_cell(c)}**" if bold and c != MISSING else _escape_cell(c) for c in cells]))
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Return the table as CSV in full precision; missing cells are empty, and formulas are escaped."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(map(escape_csv, self.heads()))
        writer.writerows([_cell(value) for value in row] for row in self.rows)
        return stream.getvalue()


def _cell(value: Value) -> Value:
    return "" if value is None else escape_csv(value) if isinstance(value, str) else value


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _escape_cell(text: str) -> str:
    """Return a text that ends no cell, starts no element and stays on its line."""
    flat = text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
    return escape_markdown(flat)
