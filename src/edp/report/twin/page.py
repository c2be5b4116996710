"""The page of a twin: one offline HTML file of its free runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.evaluation.free_run_file import PARTS
from edp.report.common.provenance import provenance_rows
from edp.report.common.templates import template
from edp.report.run.page import shown
from edp.report.twin import facts as words
from edp.report.twin.charts import twin_charts
from edp.report.twin.facts import FreeRunFacts, read_free_runs
from edp.storage import write_bytes
from edp.wording import unbroken


def build_twin_report(run_folder: str | Path, output: str | Path | None = None, title: str | None = None) -> Path:
    """Write the page of a twin as one HTML file that opens with no network.

    Args:
        run_folder: folder of `edp twin`, or one in it that `edp evaluate` wrote.
        output: where to write; ``report.html`` in the folder by default.
        title: of the page; the folder's name by default.

    Returns:
        The file written.

    Raises:
        StorageError: the folder cannot be read, or the page cannot be written.
    """
    target = Path(output) if output is not None else Path(run_folder) / "report.html"
    return write_twin_page(read_free_runs(run_folder), target, title)


def write_twin_page(facts: FreeRunFacts, target: str | Path, title: str | None = None) -> Path:
    """Write the page of free runs that are at hand.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), render(facts, title).encode("utf-8", "replace"))
    return Path(target)


def render(facts: FreeRunFacts, title: str | None = None) -> str:
    """The page's text."""
    figures = shown(twin_charts(facts))
    context: dict[str, Any] = {
        "title": title or facts.title,
        "headline": unbroken(words.headline(facts)),
        "verdict": words.verdict(facts),
        "tiles": words.tiles(facts),
        "sheets": {name: sheet.table() for name, sheet in words.sheets_of(facts).items()},
        "moments": facts.steps.moments if facts.steps else 0,
        "provenance": provenance_rows(facts.provenance),
        "parts": [part for part in PARTS if f"runs_{part}" in figures["plots"]],
        **figures,
    }
    return template("twin.html.jinja").render(**context)
