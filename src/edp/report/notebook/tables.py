"""Tables as HTML and as plain text: names in them come from files and stay text."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from edp.evaluation.study import StudyFile
from edp.report.run.facts import Facts
from edp.report.run.tables import comparison_tables
from edp.report.search import words
from edp.report.search.tables import phases_table
from edp.table import Table
from edp.wording import printable

TERMINAL = 80
"""Line width in characters that every terminal supports."""
_GAP = "  "
_CELL = "padding:2px 10px;text-align:"


def html_of(tables: Iterable[Table], title: str = "") -> str:
    """Return the tables one below the other, escaped; the rows of the network are bold."""
    parts = [f"<p><b>{_safe(title)}</b></p>"] if title else []
    for table in tables:
        heads = table.heads()
        cells = "".join(_tag("th", head, column_index) for column_index, head in enumerate(heads))
        head = f"<thead><tr>{cells}</tr></thead>" if any(heads) else ""
        rows = "".join(_row(row, number in table.marked) for number, row in enumerate(table.texts()))
        caption = f"<caption>{_safe(table.caption)}</caption>" if table.caption else ""
        parts.append(f"<table>{caption}{head}<tbody>{rows}</tbody></table>")
    return f"<div>{''.join(parts)}</div>"


def text_of(table: Table, width: int = TERMINAL) -> str:
    """Return a table as text for a terminal, in columns of constant width.

    Headings are broken at spaces; columns that do not fit beside the others follow below, behind the names again.

    Args:
        table: table to print.
        width: characters of a line; only a single column that is wider goes beyond it.
    """
    bodies = list(zip(*table.texts(), strict=True)) or [()] * len(table.columns)
    columns = [
        [[printable(word) for word in head.split(" ")], [printable(cell) for cell in cells]]
        for head, cells in zip(table.heads(), bodies, strict=True)
    ]
    widths = [max(map(len, [*words, *cells])) for words, cells in columns]
    groups: list[list[int]] = [[]]
    for index in range(1, len(columns)):
        used = widths[0] + sum(widths[i] + len(_GAP) for i in groups[-1])
        if groups[-1] and used + len(_GAP) + widths[index] > width:
            groups.append([])
        groups[-1].append(index)
    caption = [printable(table.caption)] if table.caption else []
    return "\n".join([*caption, *(line for group in groups for line in _lines(columns, widths, [0, *group]))])


def _lines(columns: Sequence[Sequence[list[str]]], widths: Sequence[int], chosen: Sequence[int]) -> list[str]:
    """Return the lines of some columns: headings, which end on the same line, followed by cells."""
    heads = [_break_words(columns[i][0], widths[i]) for i in chosen]
    tall = max(map(len, heads)) if any(any(head) for head in heads) else 0
    rows = [[head[len(head) - tall + row] if len(head) - tall + row >= 0 else "" for head in heads]
            for row in range(tall)]  # fmt: skip
    rows += [list(row) for row in zip(*(columns[i][1] for i in chosen), strict=True)]
    return [_align_cells(row, [widths[i] for i in chosen]) for row in rows]


def _break_words(words: Sequence[str], width: int) -> list[str]:
    """Break words into lines of a maximum width; longer words have a line of their own."""
    lines = [words[0]]
    for word in words[1:]:
        if len(lines[-1]) + 1 + len(word) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def score_tables(facts: Facts) -> list[Table]:
    """Return one table per horizon: every evaluated model, the best first."""
    return comparison_tables(facts)


def study_html(study: StudyFile) -> str:
    """Return the result of a search and the progress of its phases."""
    sentences = " ".join([words.headline(study), *words.verdict(study)])
    phases = phases_table(study)
    return f"<div><p>{_safe(sentences)}</p>{html_of([phases] if phases is not None else [])}</div>"


def _align_cells(cells: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (
        cell.ljust(width) if column_index == 0 else cell.rjust(width)
        for column_index, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return _GAP.join([first, *others]).rstrip()


def _row(cells: Sequence[str], marked: bool) -> str:
    style = ' style="font-weight:600"' if marked else ""
    return f"<tr{style}>{''.join(_tag('td', cell, column_index) for column_index, cell in enumerate(cells))}</tr>"


def _tag(name: str, text: str, column_index: int) -> str:
    return f'<{name} style="{_CELL}{"left" if column_index == 0 else "right"}">{_safe(text)}</{name}>'


def _safe(text: str) -> str:
    return html.escape(printable(text))
