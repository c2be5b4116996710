"""Offline HTML page of a run folder: figures by its own scripts, no network access, safe names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from markupsafe import Markup

from edp.report.common.chart import Chart
from edp.report.common.page import Fold, Page, Paragraph, Part, Section, Subsection, Terms
from edp.report.common.provenance import provenance_rows
from edp.report.run import facts as run
from edp.report.run import tables
from edp.report.run.charts import DOTS_AT_MOST, run_charts, signal_chart, signals_of
from edp.report.run.choice import candidates_table, model_tables, promise_line, promise_table, read_choice
from edp.report.run.residuals import correlogram, fit_table
from edp.storage.paths import full_path
from edp.wording import moment, unbroken

METRICS = (
    "RMSE is the root of the mean squared error, by which models are compared, MAE the mean absolute error, both means "
    "over all outputs; 95 % and 99 % of the absolute errors lie below P95 and P99. The composite score is 0.40 MAE + "
    "0.15 RMSE + 0.25 P95 + 0.20 P99."
)
FIT = "Fit is 100 % (1 − √(1 − R²)): 100 % less the RMSE over the deviation of the truth; 0 % is as good as the mean."
MODELS = (
    "Left-out data: of the models that were tried, what they say of rows that did not train them; of baselines, the "
    "validation part, which also chose their sizes. Only the model that is kept has met the test recordings; a dash "
    "stands where nothing was measured."
)
MAX_OPEN = 3
"""Number of model tables that are expanded initially."""


def build_report(
    run_folder: str | Path,
    output: str | Path | None = None,
    title: str | None = None,
    limit: str | Path | None = None,
) -> Path:
    """Write the report of a run as one HTML file that opens with no network.

    Args:
        run_folder: Folder that training and evaluation wrote; what is missing in it is named on the page.
        output: Where to write; ``report.html`` in the run folder by default.
        title: Heading of the page; the task's name by default.
        limit: File of the limit of predictability; by default the one beside the run's data, where there is one.

    Returns:
        The file written.

    Raises:
        StorageError: the folder or one of its files cannot be read, or the page cannot be written.
        DataError: predictions and scores do not belong together.
    """
    facts = run.read_facts(run_folder, limit)
    target = Path(output) if output is not None else facts.folder / "report.html"
    return build_run_page(facts, title).write(target)


def build_run_page(facts: run.Facts, title: str | None = None) -> Page:
    """Return the page of a run; its default title is the task's name."""
    drawn = (signal_chart(facts), *run_charts(facts), correlogram(facts))
    charts = {chart.name: chart for chart in drawn if chart is not None}
    name = full_path(facts.folder).name
    title = title or (facts.scores.task.name if facts.scores else "") or name
    network = run.label_of(facts, run.NETWORK) if run.NETWORK in facts.models else ""
    created = moment(facts.provenance.created if facts.provenance else None)
    return Page(
        title=title,
        kind="report",
        about=[text for text in (network, f"run {name}" if name != title else "", created) if text],
        headline=run.headline(facts),
        verdict=run.verdict_lines(facts),
        tiles=tables.key_figures(facts),
        sections=[
            Section(
                "signals",
                "Raw signals",
                [
                    f"What the network reads in the test recording {signals_of(facts)}: sensors that stand still, clip "
                    "or swap show here before they show in any score.",
                    charts.get("signals"),
                ],
            ),
            Section("baselines", "Against the baselines", _comparisons(facts), "Baselines"),
            Section(
                "predictions",
                "Prediction against truth",
                [
                    "Each prediction is drawn at the moment it speaks of, so a late model lags to the right; drag to "
                    "zoom, double-click to go back.",
                    charts.get("predictions")
                    or _missing(
                        facts,
                        "predictions.safetensors",
                        "Predictions can be drawn once scores.json says what their horizons and outputs are.",
                    ),
                ],
            ),
            Section("choice", "Why this model", _choice(facts)),
            Section("unseen", "Machines never seen", _unseen(facts)),
            Section("where", "Where the error is", _errors(facts, charts)),
            Section(
                "residuals",
                "Residuals",
                [
                    "Prediction minus truth over the recordings kept; a narrow peak at zero is good, a shifted one is "
                    "a bias, and wide feet are rare large errors.",
                    charts.get("residuals")
                    or _missing(
                        facts,
                        "predictions.safetensors",
                        "Residuals can be drawn once scores.json says what the horizons and outputs of the predictions "
                        "are.",
                    ),
                    Subsection(
                        [
                            "Correlation of the network's residuals with themselves some samples earlier. Up to the "
                            "horizon residuals overlap and must correlate; what stays outside the dashed bounds beyond "
                            "it is motion that a better model could predict.",
                            charts.get("whiteness"),
                        ],
                        "What they still hold",
                    ),
                ],
            ),
            Section(
                "learning",
                "Learning curves",
                [
                    "Training and validation should fall together; a validation curve that turns upward is "
                    "overfitting, and the dotted line marks the weights that were kept.",
                    charts.get("learning")
                    or _missing(facts, "history.jsonl", "history.jsonl holds no finished epoch."),
                ],
            ),
            Section("footprint", "Footprint", _footprint(facts)),
            Section("provenance", "Configuration and provenance", _provenance(facts), "Provenance"),
        ],
    )


def _missing(facts: run.Facts, file: str, otherwise: str) -> Paragraph:
    """Return the reason for an empty section: a missing file with the command that makes it, or `otherwise`."""
    if file not in facts.absent:
        return Paragraph(otherwise, "missing")
    text = Markup("This run has no <code>{}</code>, so there is nothing to show here. <code>{}</code> makes it.")
    return Paragraph(text.format(file, f"{run.MAKERS[file]} {facts.folder}"), "missing")


def _comparisons(facts: run.Facts) -> list[Part | None]:
    aid = (
        "Errors on the test recordings, never seen in training, best model first; a network that does not lead this "
        "table brings no benefit."
    )
    comparisons = tables.comparison_tables(facts)
    if not comparisons:
        return [aid, _missing(facts, "scores.json", "scores.json holds no scored model.")]
    fit = fit_table(facts)
    return [
        aid,
        comparisons[0],
        Paragraph(METRICS, "quiet"),
        Fold("The other horizons", comparisons[1:]),
        tables.output_table(facts),
        tables.interval_table(facts),
        fit,
        Paragraph(FIT, "quiet") if fit else None,
    ]


def _choice(facts: run.Facts) -> list[Part | None]:
    """Return the choice of the preset auto; empty for any other run."""
    choice = read_choice(facts.folder)
    if choice is None:
        return []
    why = unbroken(" ".join(filter(None, (choice.sentence, *(choice.notes or ()), promise_line(choice)))))
    models = model_tables(facts, choice)
    return [
        f"{why} The test recordings played no part in the choice.",
        candidates_table(choice),
        promise_table(facts, choice),
        Fold("Every model, output by output", [MODELS, *models], is_open=len(models) <= MAX_OPEN),
    ]


def _unseen(facts: run.Facts) -> list[Part | None]:
    """Return the errors on machines that were never seen, of a run over many machines; empty for any other run."""
    foundation = facts.foundation
    if foundation is None:
        return []
    unit = facts.unit or "report units"
    return [
        "Whole machines were held out. If the network identifies its machine as it runs, the error falls with the time "
        "since its state was reset.",
        tables.contexts_table(foundation, unit),
        tables.machine_parts_table(foundation),
        Fold("Each machine", [tables.machines_table(foundation, unit)]),
    ]


def _errors(facts: run.Facts, charts: Mapping[str, Chart]) -> list[Part | None]:
    """Return the errors by horizon, speed, situation and recording."""
    network = facts.models.get(run.NETWORK)
    ranked = network is not None and len(network.recordings) > DOTS_AT_MOST
    horizons = len(tables.comparison_tables(facts)) > 1
    how = "How fast the error grows with the horizon; " if horizons else "This run predicts one fixed time ahead; "
    by_recording = (
        "Test recordings from the easiest to the hardest; where the blue line lies below the dots the network wins."
        if ranked
        else "One row per test recording, the easiest on top; a blue dot left of the others is a recording on which "
        "the network wins."
    )
    horizon, worst = run.main_horizon(facts), tables.worst_recordings_table(facts)
    return [
        Subsection(
            [
                f"{how}the gap to the baselines is what the network adds.",
                charts.get("horizon") or _missing(facts, "scores.json", "scores.json holds no errors by horizon."),
            ],
            "By horizon",
        ),
        Subsection(
            [
                "Error while the machine moves slowly or fast; the grey bars say how much of the test data each band "
                "holds.",
                charts.get("speed") or _missing(facts, "scores.json", "scores.json holds no errors by speed."),
            ],
            "By speed",
        ),
        Subsection(
            [
                "What the axis did, told from measured channels; but for the last a tick may stand in several rows. "
                "Shares are means over the axes.",
                None if facts.scores is None or horizon is None else tables.situation_table(facts.scores, horizon),
            ],
            "By situation",
        ),
        Subsection(
            [
                " ".join(filter(None, (by_recording, run.spread_text(facts)))),
                charts.get("recordings") or _missing(facts, "scores.json", "scores.json holds no errors by recording."),
                # Few recordings are read from the figure.
                Fold("The hardest recordings in figures", [worst if worst and len(worst.rows) > 3 else None]),
            ],
            "By recording",
        ),
    ]


def _footprint(facts: run.Facts) -> list[Part | None]:
    """Return the cost of a prediction and the limits of the budget."""
    budget = facts.footprint.stated_budget if facts.footprint else None
    rows, checks = tables.footprint_rows(facts), tables.budget_table(facts)
    against = (
        Markup("against what {} grants").format(budget.name)
        if budget
        else Markup("<code>edp report RUN --budget FILE</code> holds it against that of your machine")
    )
    missing = "footprint.json" in facts.absent or not (checks.rows or rows)
    return [
        Paragraph(Markup("What one prediction costs on a controller{}{}.").format(", " if budget else "; ", against)),
        checks,
        Subsection([Terms(rows, in_columns=True)], "Size and work"),
        Fold("Parameters and work by part", [tables.part_table(facts)]),
        _missing(facts, "footprint.json", "footprint.json is empty.") if missing else None,
    ]


def _provenance(facts: run.Facts) -> list[Part | None]:
    """Return what made the run, and its configuration."""
    rows = provenance_rows(facts.provenance)
    config = None if facts.config is None else Markup("<pre>{}</pre>").format(facts.config)
    return [
        "What it takes to make this run again: command, seed, data and versions.",
        Terms(rows) if rows else _missing(facts, "provenance.json", "provenance.json is empty."),
        _missing(facts, "config.toml", "") if config is None else None,
        Fold("Configuration (config.toml)", [config], is_printed=False),
    ]
