"""The report of a search for a smaller network: one offline HTML page, tables and pictures."""

from __future__ import annotations

from pathlib import Path

from edp.evaluation.compression import read_compression
from edp.report.common.page import Page, Paragraph, Points, Section, write_report
from edp.report.compression import facts as words
from edp.report.compression.charts import front_chart, profile_chart
from edp.storage.paths import full_path


def write_compression_page(folder: str | Path, pictures: bool = True) -> Path:
    """Write page, tables and pictures of a compression search.

    Writes ``report.html``, ``tables/*.csv``, ``tables/*.md`` and ``pictures/*`` into the folder of `edp compress
    search`.

    Returns:
        The page.

    Raises:
        StorageError: the folder holds no search, or a file cannot be written.
    """
    facts = read_compression(folder)
    tables = [words.front_table(facts, horizon) for horizon in reversed(facts.horizons)]
    held_out = words.tabulate_held_out(facts)
    charts = [profile_chart(facts), front_chart(facts)]
    page = Page(
        title=full_path(Path(folder)).name,
        kind="compression",
        about=["compression", facts.budget.name],
        headline=words.headline(facts),
        verdict=words.verdict(facts),
        tiles=words.tiles(facts),
        sections=[
            Section(
                "front",
                "Error against cost",
                [
                    "Error on the validation part over that of the teacher in float32, the mean over horizons. Below "
                    "and left is better; the step line joins those that no other one betters at no greater cost; the "
                    "dotted line is the budget.",
                    charts[1],
                ],
                "Front",
            ),
            Section(
                "profile",
                "Size profile",
                [
                    "Left: parameters as bars, mean absolute error before (in float32) and after (in the smallest "
                    "format of the network), all on logarithmic axes. Right: the composite score.",
                    charts[0],
                ],
            ),
            Section(
                "tables",
                "All networks",
                ["What no other network betters in error, cycles and bytes of parameters stands out.", *tables],
                "Tables",
            ),
            Section(
                "held-out",
                "Sealed test set",
                [Paragraph("Not opened: no network fits the budget.", "missing")]
                if held_out is None
                else [
                    f"Opened on {facts.held_out_test.opened}, for the chosen network and the teacher.",
                    held_out,
                ],
            ),
            Section("reading", "What it can and cannot show", [Points(words.caveats(facts))], "What it can show"),
        ],
        footer="Its pictures and tables lie beside it.",
    )
    files = [*tables, held_out] if held_out else tables
    return write_report(page, Path(folder) / "report.html", files, charts if pictures else [])
