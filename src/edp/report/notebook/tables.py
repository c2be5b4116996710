"""Tables as HTML and as plain text: names in them come from files and stay text."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from edp.report.common.tables import TextTable, comparison_tables
from edp.report.common.wording import printable
from edp.report.run.facts import Facts
from edp.report.search import words
from edp.report.search.facts import StudyFacts
from edp.report.search.tables import phases_sheet

_CELL = "padding:2px 10px;text-align:"


def html_of(tables: Iterable[TextTable], title: str = "") -> str:
    """Tables one below the other, escaped; the rows of the network are bold."""
    parts = [f"<p><b>{_safe(title)}</b></p>"] if title else []
    for table in tables:
        cells = "".join(_tag("th", _headed(*column), column_index) for column_index, column in enumerate(table.columns))
        head = f"<thead><tr>{cells}</tr></thead>" if any(map(any, table.columns)) else ""
        rows = "".join(_row(row, number in table.marked) for number, row in enumerate(table.rows))
        caption = f"<caption>{_safe(table.caption)}</caption>" if table.caption else ""
        parts.append(f"<table>{caption}{head}<tbody>{rows}</tbody></table>")
    return f"<div>{''.join(parts)}</div>"


def text_of(table: TextTable) -> str:
    """A table in columns of one width each, for a terminal."""
    heads = [[_headed(*column) for column in table.columns]] if any(map(any, table.columns)) else []
    lines = [*heads, *map(list, table.rows)]
    lines = [[printable(cell) for cell in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    texts = [_aligned(line, widths) for line in lines]
    return "\n".join([*([printable(table.caption)] if table.caption else []), *texts])


def score_tables(facts: Facts) -> list[TextTable]:
    """A table for each horizon: every judged model, the best first."""
    return comparison_tables(facts)


def study_html(study: StudyFacts) -> str:
    """What a search came to, and how far its phases are."""
    sentences = " ".join([words.headline(study), *words.verdict(study)])
    sheet = phases_sheet(study)
    return f"<div><p>{_safe(sentences)}</p>{html_of([sheet.table()] if sheet is not None else [])}</div>"


def _headed(heading: str, unit: str) -> str:
    return f"{heading} [{unit}]" if unit else heading


def _aligned(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (
        cell.ljust(width) if column_index == 0 else cell.rjust(width)
        for column_index, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return "  ".join([first, *others]).rstrip()


def _row(cells: Sequence[str], marked: bool) -> str:
    style = ' style="font-weight:600"' if marked else ""
    return f"<tr{style}>{''.join(_tag('td', cell, column_index) for column_index, cell in enumerate(cells))}</tr>"


def _tag(name: str, text: str, column_index: int) -> str:
    return f'<{name} style="{_CELL}{"left" if column_index == 0 else "right"}">{_safe(text)}</{name}>'


def _safe(text: str) -> str:
    return html.escape(printable(text))
