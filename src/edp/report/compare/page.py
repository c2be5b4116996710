"""The page of a comparison, and its tables."""

from __future__ import annotations

from edp.errors import count_of
from edp.report.common.page import Fold, Page, Section, Subsection
from edp.report.compare.charts import compare_charts
from edp.report.compare.paired import Comparison
from edp.report.compare.runs import Measure
from edp.table import Column, Table, Value, chance, figures
from edp.wording import count_text, number, percent

SHOWN_ERRORS = 4
"""Number of error tables that are expanded initially."""


def build_compare_page(comparison: Comparison, title: str = "") -> Page:
    """Return the page of a comparison; its default title is the names of the first two runs."""
    measure, first = comparison.measures[0], comparison.runs[0].name
    charts = {chart.name: chart for chart in compare_charts(comparison)}
    errors = [error_table(comparison, one) for one in comparison.measures]
    runs, recordings = len(comparison.runs), len(comparison.recordings)
    return Page(
        title=title or " and ".join(run.name for run in comparison.runs[:2]),
        kind="comparison",
        about=["comparison", f"{count_of(runs, 'run')} on {count_of(recordings, 'common test recording')}"],
        headline=comparison.headline(),
        verdict=comparison.remarks,
        tiles=[
            (number(comparison.error(run, measure)), measure.unit, f"{run.name}: {measure.text()}")
            for run in comparison.runs[:4]
        ],
        sections=[
            Section(
                "errors",
                f"Errors, and differences from {first}",
                [
                    "Means over the common test recordings, each of the same weight. A difference is paired: both runs "
                    "answer for the same recording, so that hard recordings do not blur it. An interval that holds "
                    "zero leaves open which run is better; p-values are two-sided and adjusted for the number of runs.",
                    charts.get("change"),
                    *errors[:SHOWN_ERRORS],
                    Fold("The other errors", errors[SHOWN_ERRORS:]),
                ],
                "Errors",
            ),
            Section(
                "horizon",
                "By time ahead",
                [
                    "How fast the errors grow; lines that cross are runs for different purposes.",
                    charts.get("horizon"),
                ],
            ),
            Section(
                "recordings",
                "By recording",
                [
                    f"One row a common test recording, the easiest for {first} on top: a run that is better only on "
                    "some kinds of recordings shows here.",
                    charts.get("recordings"),
                    Fold("The same in figures", [recording_table(comparison, measure)]),
                ],
            ),
            Section(
                "learning",
                "Learning curves",
                [
                    "Each run on its own validation part; levels are comparable only where that part is the same.",
                    charts.get("learning"),
                ],
            ),
            Section(
                "models",
                "Size and cost",
                [
                    Subsection(
                        [
                            "Below and to the left is better: less error with less work. Cycles are estimates for the "
                            "budget's core.",
                            charts.get("cost"),
                        ]
                    ),
                    model_table(comparison),
                ],
            ),
        ],
    )


def error_table(comparison: Comparison, measure: Measure) -> Table:
    """Return each run's error and its paired difference from the first run."""
    differences = comparison.differences(measure)
    rows: list[tuple[Value, ...]] = []
    for run in comparison.runs:
        error = comparison.error(run, measure)
        difference = differences.get(run.name)
        if difference is None:
            rows.append((run.name, error, None, None, None, None))
            continue
        ends = (difference.low, difference.high)
        interval = " to ".join(percent(end, signed=True) for end in ends) if None not in ends else None
        better = f"{difference.better} of {len(comparison.recordings)}"
        rows.append((run.name, error, percent(difference.change, signed=True), interval, difference.p, better))
    columns = (
        Column("Run"),
        Column("Error", measure.unit, figures(row[1] for row in rows)),
        Column("Change"),
        Column("95 % interval"),
        Column("p", "Holm", chance),
        Column("Better on"),
    )
    return Table(measure.text(), columns, tuple(rows), name="errors")


def recording_table(comparison: Comparison, measure: Measure) -> Table:
    """Return each run's error on each common recording."""
    errors = {run.name: comparison.errors(run, measure).tolist() for run in comparison.runs}
    rows = tuple(
        (name, *(errors[run.name][i] for run in comparison.runs)) for i, name in enumerate(comparison.recordings)
    )
    show = figures(value for values in errors.values() for value in values)
    columns = (Column("Recording"), *(Column(run.name, measure.unit, show) for run in comparison.runs))
    return Table(measure.text(), columns, rows, name="recordings")


def model_table(comparison: Comparison) -> Table:
    """Return a table of the runs: model, size, cost."""
    costs = list(dict.fromkeys(cost for run in comparison.runs for cost in run.costs))
    rows = tuple(
        (run.name, run.label, *(count_text(run.costs[cost]) if cost in run.costs else None for cost in costs))
        for run in comparison.runs
    )
    return Table("Models", (Column("Run"), Column("Model"), *map(Column, costs)), rows, name="models")
