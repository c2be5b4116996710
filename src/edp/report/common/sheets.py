"""Tables that keep their values: as text on a page, as Markdown for documents, as CSV for other programs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from edp.report.common.chart import with_unit
from edp.report.common.tables import TextTable
from edp.storage import make_folder, write_bytes
from edp.wording import MISSING, decimals_for, in_cell, in_markdown, number, unit_text

Value = float | int | str | None
Show = Callable[[Value], str]


def plainly(value: Value) -> str:
    """Text as it is, a dash where there is none."""
    return MISSING if value is None or value == "" else str(value)


def figures(values: Iterable[Value], signed: bool = False, decimals: int | None = None) -> Show:
    """Numbers of one column with one precision."""
    numbers = [value for value in values if isinstance(value, int | float)]
    places = decimals_for(numbers) if decimals is None else decimals

    def show(value: Value) -> str:
        return number(value, places, signed) if isinstance(value, int | float) else plainly(value)

    return show


def chance(value: Value) -> str:
    """A p-value: three decimals, and what is smaller as a bound."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return plainly(value if isinstance(value, str) else None)
    # A p-value of zero or one would claim certainty that no test has.
    return "< 0.001" if value < 0.0005 else "> 0.999" if 0.9995 < value < 1 else f"{value:.3f}"


@dataclass(frozen=True)
class Column:
    """Heading, unit and how a value is shown."""

    heading: str
    unit: str = ""
    show: Show = plainly


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        name: of its file.
        caption: above it.
        columns: of each row.
        rows: values; None where there is none.
        marked: places of rows that stand out.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]
    marked: frozenset[int] = frozenset()

    def texts(self) -> tuple[tuple[str, ...], ...]:
        """Cells as a reader sees them."""
        return tuple(tuple(column.show(value) for column, value in zip(self.columns, row)) for row in self.rows)

    def table(self) -> TextTable:
        """For a page."""
        columns = tuple((column.heading, unit_text(column.unit)) for column in self.columns)
        return TextTable(self.caption, columns, self.texts(), self.marked)

    def heads(self) -> list[str]:
        """Headings, each with its unit."""
        return [with_unit(c.heading, c.unit) for c in self.columns]

    def markdown(self) -> str:
        """For a document: the caption and a table; what stands out is bold."""
        heads = [_piped(head) for head in self.heads()]
        lines = [f"**{_piped(self.caption)}**", "", _row(heads), _row(["---"] * len(heads))]
        for row, cells in enumerate(self.texts()):
            bold = row in self.marked
            lines.append(_row([f"**{_piped(c)}**" if bold and c != MISSING else _piped(c) for c in cells]))
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """For other programs: full precision, empty where there is no value; text is text to a spreadsheet, too."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(map(in_cell, self.heads()))
        writer.writerows([_cell(value) for value in row] for row in self.rows)
        return stream.getvalue()


def write_sheets(folder: Path, sheets: Iterable[Sheet]) -> None:
    """Write each table as ``<name>.csv`` and ``<name>.md``.

    Raises:
        StorageError: a file cannot be written.
    """
    for sheet in sheets:
        stem = make_folder(folder) / sheet.name
        write_bytes(stem.with_suffix(".csv"), sheet.csv().encode("utf-8", "replace"))
        write_bytes(stem.with_suffix(".md"), sheet.markdown().encode("utf-8", "replace"))


def _cell(value: Value) -> Value:
    return "" if value is None else in_cell(value) if isinstance(value, str) else value


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _piped(text: str) -> str:
    """Text that ends no cell, starts no element and stays on its line."""
    flat = text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
    return in_markdown(flat)
