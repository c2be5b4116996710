"""The report of a study on disk: one offline HTML page, pictures, Markdown and CSV tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from edp.evaluation.study import StudyFile
from edp.report.common.chart import Chart
from edp.report.common.page import Fold, Page, Paragraph, Part, Points, Section, Subsection, Terms
from edp.report.common.picture import write_pictures
from edp.report.search import words
from edp.report.search.charts import study_charts
from edp.report.search.facts import reading
from edp.report.search.tables import study_tables
from edp.storage import make_folder, write_bytes
from edp.table import Table
from edp.wording import escape_markdown, number

MAX_IN_A_LINE = 4
"""Maximum number of sentences of a decision that form a paragraph. More sentences form a list."""
VARIANCE = (
    "Every run of phase 0 in the same order of folds. A line joins the seeds of a run, a bar is the arm's mean: folds "
    "that lie apart are split variance, long lines are seed variance. Where all arms rise and fall together, only "
    "paired differences tell them apart."
)
PARETO = (
    "Networks that were asked about, all judged on the same folds with the same seeds. Below and left is better; the "
    "step line joins those that no other one betters at no greater cost. Single trainings: neighbours on the front may "
    "be there by chance."
)
CONFIRMATION_SOUND = (
    "Effect of each module on the score with its 95 % interval. In phase 3 p is of the two-way clustered t-test, "
    "beside it the value adjusted over every registered module; the dotted line is the least relevant gain."
)
CONFIRMATION_THESIS = (
    "Effect size d_z of each module with its 95 % interval from the noncentral t-distribution, p as the thesis prints "
    "it (Φ(d_z √J)), and the mixed model's value adjusted over the modules tested; the dotted line is the thesis's "
    "gate."
)
SCREENING_SOUND = (
    "Main effect of each module in a two-level design, with 1.96 standard errors to both sides. Phase 2 is to lose few "
    "good modules, not to confirm any."
)
SCREENING_THESIS = (
    "The best of each module's questions is compared with the median of the baseline, which favours every module."
)
COMPRESSION = (
    "Networks are compared and chosen on development sessions that do not train; the second sealed test set is opened "
    "for the chosen one and the teacher alone. Cycles are estimates, and the high one decides."
)
HISTORY = (
    "Every training in the order in which it was asked for; the steps are the best of a phase so far. Phases differ in "
    "folds and in length of training, so their levels are not to be compared."
)
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
    for name, table in tables.items():
        table_files.append(make_folder(folder / "tables") / f"{name}.csv")
        write_bytes(table_files[-1], table.csv().encode("utf-8", "replace"))
    drawn = reading("study.json", lambda: write_pictures(folder / "pictures", study_charts(study))) if pictures else []
    return StudyReport(target, document, tuple(table_files), tuple(drawn))


def _contents(study: StudyFile) -> tuple[str, str, dict[str, Table]]:
    tables = study_tables(study)
    return build_study_page(study, tables).html(), study_text(study, tables), tables


def build_study_page(study: StudyFile, tables: Mapping[str, Table]) -> Page:
    """Return the page of a study.

    Args:
        study: the study.
        tables: result of `study_tables`.
    """
    charts = {chart.name: chart for chart in study_charts(study)}
    get, is_sound, second = tables.get, study.mode == "sound", study.sessions.second

    def missing(*phases: str) -> Part | None:
        text = words.missing(study, *phases)
        return Paragraph(text, "missing") if text else None

    return Page(
        title=study.title,
        kind="model search",
        about=["model search", _describe_study(study)],
        headline=words.headline(study),
        verdict=words.verdict(study),
        tiles=words.tiles(study),
        sections=[
            Section(
                "decided",
                "What was decided, and why",
                [Terms([(phase, _sentences(lines)) for phase, lines in words.decided(study)])],
                "Decided",
            ),
            Section("reading", "What it can and cannot show", [Points(words.caveats(study))], "What it can show"),
            Section(
                "variance",
                "Variance and feature sets",
                [
                    missing("isolation"),
                    _figure(charts, "variance", VARIANCE),
                    get("variance"),
                    get("features"),
                ],
                "Variance",
            ),
            Section(
                "calibration",
                "Baseline and size",
                [missing("calibration"), _figure(charts, "pareto", PARETO), get("calibration")],
                "Baseline",
            ),
            Section(
                "modules",
                "Modules",
                [
                    missing("screening", "confirmation"),
                    _figure(
                        charts, "confirmation", CONFIRMATION_SOUND if is_sound else CONFIRMATION_THESIS, "Confirmation"
                    ),
                    get("modules"),
                    Fold("Other tests" if is_sound else "Every metric", [get("tests")]),
                    _figure(charts, "screening", SCREENING_SOUND if is_sound else SCREENING_THESIS, "Screening"),
                    Fold("The same in figures", [get("effects")]),
                ],
            ),
            Section(
                "networks",
                "Networks that were found",
                [
                    missing("synthesis", "exploration", "compression"),
                    get("holdout"),
                    Subsection([COMPRESSION, get("compression")], "For the controller"),
                    Subsection(
                        [
                            "How often a sampler turned a module on says what it tried, not what helps: effects are "
                            "above.",
                            Fold("Selection frequency and identifiers", [get("selection"), get("identifiers")]),
                        ]
                    ),
                ],
                "Networks",
            ),
            Section(
                "history",
                "Search history",
                [_figure(charts, "history", HISTORY) or Paragraph("No training has a score yet.", "missing")],
                "History",
            ),
            Section(
                "openings",
                "Sealed test set",
                [
                    f"Sessions set apart before anything else: {', '.join(study.sessions.test)}"
                    f"{'; for phase 6 ' + ', '.join(second) if second else ''}. Each opening is recorded "
                    "before it is made; only the first is free of choices that an earlier one could have steered.",
                    get("openings") or Paragraph("Not opened yet.", "missing"),
                ],
            ),
            Section(
                "cost",
                "Time and trainings",
                [
                    get("phases"),
                    Paragraph(SCORE, "quiet"),
                    Fold("Settings, data and sessions", [Terms(_settings(study))], is_printed=False),
                ],
                "Time",
            ),
        ],
        footer="Its pictures and tables lie beside it.",
    )


def _figure(charts: Mapping[str, Chart], name: str, text: str, title: str = "") -> Subsection | None:
    """Return a figure with its explanation; None without data."""
    return Subsection([text, charts[name]], title) if name in charts else None


def _sentences(lines: Sequence[str]) -> str | Points:
    """Return sentences as text, many of them as a list."""
    return Points(lines[1:], lines[0]) if len(lines) > MAX_IN_A_LINE else " ".join(lines)


def _settings(study: StudyFile) -> list[tuple[str, str]]:
    """Return data, sessions and settings of a study."""
    sets = study.sessions
    sessions = [("development", sets.development), ("test", sets.test), ("second sealed test set", sets.second)]
    return [
        ("data", study.data.path),
        ("hash of the data", study.data.hash),
        *((name, ", ".join(names)) for name, names in sessions if names),
        *words.settings(study),
    ]


def _describe_study(study: StudyFile) -> str:
    hours = number(study.data.hours, 1)
    return f"{study.mode} mode · preset {study.preset} · {study.data.sessions} sessions, {hours} h · {study.state}"


def study_text(study: StudyFile, tables: Mapping[str, Table]) -> str:
    """Return the report as Markdown: result, decisions with reasons, limits of the evidence, tables."""
    lines = [f"# Model search on {escape_markdown(study.title)}", "", f"{escape_markdown(_describe_study(study))}.", ""]
    lines += [escape_markdown(words.headline(study)), "", escape_markdown(" ".join(words.verdict(study))), ""]
    lines += ["## What was decided, and why", ""]
    for heading, sentences in words.decided(study):
        lines += [f"**{heading}.** {escape_markdown(' '.join(sentences))}", ""]
    caveats = [f"- {escape_markdown(line)}" for line in words.caveats(study)]
    lines += ["## What it can and cannot show", "", *caveats, ""]
    lines += ["## Tables", "", SCORE, ""]
    for table in tables.values():
        lines += [table.markdown(), ""]
    return "\n".join(lines).rstrip() + "\n"
