"""The report of a search for a smaller network: one offline HTML page, tables and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.report.common.picture import write_pictures
from edp.report.common.sheets import Sheet, write_sheets
from edp.report.common.templates import template
from edp.report.compression import facts as words
from edp.report.compression.charts import compression_charts
from edp.report.compression.facts import CompressionFacts, read_compression
from edp.report.run.page import shown
from edp.storage import write_bytes
from edp.storage.paths import full_path
from edp.wording import unbroken


def write_compression_page(folder: str | Path, pictures: bool = True) -> Path:
    """Write ``report.html``, ``tables/*.csv``, ``tables/*.md`` and ``pictures/*`` into the folder of `edp compress`.

    Returns:
        The page.

    Raises:
        StorageError: the folder holds no search, or a file cannot be written.
    """
    facts = read_compression(folder)
    tables = sheets(facts)
    page = facts.folder / "report.html"
    write_bytes(page, render(facts, tables).encode("utf-8", "replace"))
    write_sheets(facts.folder / "tables", tables)
    if pictures:
        write_pictures(facts.folder / "pictures", compression_charts(facts))
    return page


def sheets(facts: CompressionFacts) -> list[Sheet]:
    """A table a horizon, longest first, and that of the sealed test set."""
    held_out = words.held_out_sheet(facts)
    return [
        *(words.table_sheet(facts, horizon) for horizon in reversed(facts.horizons)),
        *([held_out] if held_out else []),
    ]


def render(facts: CompressionFacts, tables: list[Sheet]) -> str:
    """The page's text."""
    context: dict[str, Any] = {
        "title": full_path(facts.folder).name,
        "headline": unbroken(words.headline(facts)),
        "verdict": words.verdict(facts),
        "tiles": words.tiles(facts),
        "caveats": words.caveats(facts),
        "tables": [sheet.table() for sheet in tables if sheet.name != "held_out_test"],
        "held_out": next((sheet.table() for sheet in tables if sheet.name == "held_out_test"), None),
        "opened": facts.result.held_out_test.opened,
        "budget": facts.result.budget,
        **shown(compression_charts(facts)),
    }
    return template("compression.html.jinja").render(**context)
