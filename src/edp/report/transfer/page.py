"""The report of a transfer: one offline HTML page, tables and pictures."""

from __future__ import annotations

from pathlib import Path

from edp.evaluation.transfer_file import SOURCE
from edp.report.common.page import Page, Points, Section, write_report
from edp.report.transfer import facts as words
from edp.report.transfer.charts import error_chart, method_chart, picture_charts, prediction_chart
from edp.report.transfer.facts import Transfer, read_transfer
from edp.storage.paths import full_path


def write_transfer_page(folder: str | Path, pictures: bool = True) -> Path:
    """Write page, tables and pictures of a fine-tuning.

    Writes ``transfer.html``, ``tables/*.csv``, ``tables/*.md`` and ``pictures/*`` into the folder of `edp train
    finetune`.

    Returns:
        The page.

    Raises:
        StorageError: the folder holds no transfer, or a file cannot be written.
    """
    facts = read_transfer(folder)
    tables = [table for horizon in reversed(facts.horizons) for table in words.transfer_tables(facts, horizon)]
    drawn = picture_charts(facts) if pictures else []
    return write_report(build_transfer_page(facts), facts.folder / "transfer.html", tables, drawn)


def build_transfer_page(facts: Transfer) -> Page:
    """Return the page of a transfer."""
    both = " On the source's own recordings too: what is gained in one domain may be lost in the other."
    horizons = list(reversed(facts.horizons))
    return Page(
        title=full_path(facts.folder).name,
        kind="transfer",
        about=["transfer", facts.content.network],
        headline=words.headline(facts),
        verdict=words.verdict(facts),
        tiles=words.tiles(facts),
        sections=[
            Section(
                "pair",
                "Before and after",
                [
                    "The network of the source as it is, and trained on; both on the same ticks of the target's test "
                    "part. Bias is the mean of prediction minus truth; skew is the third standardised moment of the "
                    "errors.",
                    *(words.pair_table(facts, horizon) for horizon in horizons),
                ],
            ),
            Section(
                "predictions",
                "Predictions",
                ["The stretches of the test part in which the targets move most.", prediction_chart(facts, facts.pair)],
            ),
            Section(
                "errors",
                "Errors",
                [
                    "Share of samples by prediction minus truth. A curve that stands beside zero is a bias.",
                    error_chart(facts, facts.pair),
                ],
            ),
            Section(
                "methods",
                "All methods",
                [
                    f"Same logs, same split, same ticks.{both if SOURCE in facts.domains else ''}",
                    method_chart(facts),
                    *(words.method_table(facts, horizon) for horizon in horizons),
                ],
                "Methods",
            ),
            Section("reading", "What it can and cannot show", [Points(words.caveats(facts))], "What it can show"),
        ],
        footer="Its pictures and tables lie beside it.",
    )
