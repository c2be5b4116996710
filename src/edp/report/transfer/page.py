"""The report of a transfer: one offline HTML page, tables and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.report.common.picture import write_pictures
from edp.report.common.tables import write_tables
from edp.report.common.templates import template
from edp.report.run.page import shown
from edp.report.transfer import facts as words
from edp.report.transfer.charts import picture_charts, transfer_charts
from edp.report.transfer.facts import Transfer, read_transfer
from edp.storage import write_bytes
from edp.storage.paths import full_path
from edp.table import Table
from edp.wording import unbroken


def write_transfer_page(folder: str | Path, pictures: bool = True) -> Path:
    """Write ``transfer.html``, ``tables/*.csv``, ``tables/*.md`` and ``pictures/*`` into the folder of `edp finetune`.

    Returns:
        The page.

    Raises:
        StorageError: the folder holds no transfer, or a file cannot be written.
    """
    facts = read_transfer(folder)
    tables = [sheet for horizon in reversed(facts.horizons) for sheet in words.sheets_of(facts, horizon)]
    page = facts.folder / "transfer.html"
    write_bytes(page, render(facts, tables).encode("utf-8", "replace"))
    write_tables(facts.folder / "tables", tables)
    if pictures:
        write_pictures(facts.folder / "pictures", picture_charts(facts))
    return page


def render(facts: Transfer, tables: list[Table]) -> str:
    """The page's text."""
    context: dict[str, Any] = {
        "title": full_path(facts.folder).name,
        "network": facts.content["network"],
        "headline": unbroken(words.headline(facts)),
        "verdict": words.verdict(facts),
        "tiles": words.tiles(facts),
        "caveats": words.caveats(facts),
        "pairs": [sheet for sheet in tables if sheet.name.startswith("pair")],
        "methods": [sheet for sheet in tables if sheet.name.startswith("methods")],
        "both": words.SOURCE in facts.domains,
        **shown(transfer_charts(facts)),
    }
    return template("transfer.html.jinja").render(**context)
