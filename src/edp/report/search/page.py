"""The report of a study on disk: one offline HTML page, pictures, Markdown and CSV tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edp.evaluation.study import StudyFile
from edp.report.common.picture import write_pictures
from edp.report.common.sheets import Sheet
from edp.report.common.templates import template
from edp.report.run.page import shown
from edp.report.search import words as words
from edp.report.search.charts import study_charts
from edp.report.search.facts import reading
from edp.report.search.tables import sheets
from edp.storage import make_folder, write_bytes
from edp.wording import in_markdown, number, unbroken

SCORE = "The composite score is 0.40 MAE + 0.15 RMSE + 0.25 P95 + 0.20 P99, mean over sessions and outputs."


@dataclass(frozen=True)
class StudyReport:
    """Files of a report.

    Attributes:
        page: the HTML page.
        text: sentences and tables as Markdown.
        tables: each table as CSV.
        pictures: each picture as SVG and PNG; none where they were not asked for.
    """

    page: Path
    text: Path
    tables: tuple[Path, ...]
    pictures: tuple[Path, ...]


def write_study_page(study: StudyFile, out: str | Path, pictures: bool = True) -> StudyReport:
    """Write the report of a study: ``report.html``, ``report.md``, ``tables/*.csv`` and ``pictures/*``.

    A study that is not finished gets a report of what is decided and how far the rest is.

    Args:
        study: content of ``study.json`` (`edp.evaluation.study.read_study`).
        out: folder; it is made.
        pictures: whether to write them, which takes most of the time.

    Raises:
        StorageError: parts of the study contradict one another, or a file cannot be written.
    """
    page, text, tables = reading("study.json", lambda: _contents(study))
    folder = make_folder(out)
    target, document = folder / "report.html", folder / "report.md"
    write_bytes(target, page.encode("utf-8", "replace"))
    write_bytes(document, text.encode("utf-8", "replace"))
    table_files = []
    for name, sheet in tables.items():
        table_files.append(make_folder(folder / "tables") / f"{name}.csv")
        write_bytes(table_files[-1], sheet.csv().encode("utf-8", "replace"))
    drawn = reading("study.json", lambda: write_pictures(folder / "pictures", study_charts(study))) if pictures else []
    return StudyReport(target, document, tuple(table_files), tuple(drawn))


def _contents(study: StudyFile) -> tuple[str, str, dict[str, Sheet]]:
    tables = sheets(study)
    return render_study(study, tables), study_text(study, tables), tables


def render_study(study: StudyFile, tables: Mapping[str, Sheet]) -> str:
    """The page's text."""
    context: dict[str, Any] = {
        "title": study.title,
        "about": _about(study),
        "headline": unbroken(words.headline(study)),
        "verdict": words.verdict(study),
        "tiles": words.tiles(study),
        "decided": words.decided(study),
        "caveats": words.caveats(study),
        "missing": words.missing,
        "study": study,
        "score": SCORE,
        **shown(study_charts(study)),
        "tables": {name: sheet.table() for name, sheet in tables.items()},
        "settings": words.settings(study),
    }
    return template("study.html.jinja").render(**context)


def _about(study: StudyFile) -> str:
    hours = number(study.data.hours, 1)
    return f"{study.mode} mode · preset {study.preset} · {study.data.sessions} sessions, {hours} h · {study.state}"


def study_text(study: StudyFile, tables: Mapping[str, Sheet]) -> str:
    """The report as Markdown: what came out, what was decided and why, what it can show, and the tables."""
    lines = [f"# Model search on {in_markdown(study.title)}", "", f"{in_markdown(_about(study))}.", ""]
    lines += [in_markdown(words.headline(study)), "", in_markdown(" ".join(words.verdict(study))), ""]
    lines += ["## What was decided, and why", ""]
    for heading, sentences in words.decided(study):
        lines += [f"**{heading}.** {in_markdown(' '.join(sentences))}", ""]
    caveats = [f"- {in_markdown(line)}" for line in words.caveats(study)]
    lines += ["## What it can and cannot show", "", *caveats, ""]
    lines += ["## Tables", "", SCORE, ""]
    for sheet in tables.values():
        lines += [sheet.markdown(), ""]
    return "\n".join(lines).rstrip() + "\n"
