"""The page of a comparison, and its tables."""

from __future__ import annotations

from pathlib import Path

from edp.report.common.templates import template
from edp.report.compare.charts import compare_charts
from edp.report.compare.paired import Comparison
from edp.report.compare.runs import Measure
from edp.report.run.page import shown
from edp.storage import write_bytes
from edp.table import Column, Table, Value, chance, figures
from edp.wording import count_text, number, percent, unbroken


def write_compare_page(comparison: Comparison, target: str | Path, title: str = "") -> Path:
    """Write the page of a comparison.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), render(comparison, title).encode("utf-8", "replace"))
    return Path(target)


def render(comparison: Comparison, title: str = "") -> str:
    """The page's text."""
    measure = comparison.measures[0]
    tiles = [
        (number(comparison.error(run, measure)), measure.unit, f"{run.name}: {measure.text()}")
        for run in comparison.runs[:4]
    ]
    return template("compare.html.jinja").render(
        title=title or " and ".join(run.name for run in comparison.runs[:2]),
        runs=len(comparison.runs),
        count=len(comparison.recordings),
        first=comparison.runs[0].name,
        headline=unbroken(comparison.headline()),
        remarks=comparison.remarks,
        tiles=tiles,
        tables=[error_sheet(comparison, one) for one in comparison.measures],
        recordings=recording_sheet(comparison, measure),
        models=model_sheet(comparison),
        **shown(compare_charts(comparison)),
    )


def error_sheet(comparison: Comparison, measure: Measure) -> Table:
    """Each run's error and its paired difference from the first run."""
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


def recording_sheet(comparison: Comparison, measure: Measure) -> Table:
    """Each run's error on each common recording."""
    errors = {run.name: comparison.errors(run, measure).tolist() for run in comparison.runs}
    rows = tuple(
        (name, *(errors[run.name][i] for run in comparison.runs)) for i, name in enumerate(comparison.recordings)
    )
    show = figures(value for values in errors.values() for value in values)
    columns = (Column("Recording"), *(Column(run.name, measure.unit, show) for run in comparison.runs))
    return Table(measure.text(), columns, rows, name="recordings")


def model_sheet(comparison: Comparison) -> Table:
    """What each run is, and what it takes."""
    costs = list(dict.fromkeys(cost for run in comparison.runs for cost in run.costs))
    rows = tuple(
        (run.name, run.label, *(count_text(run.costs[cost]) if cost in run.costs else None for cost in costs))
        for run in comparison.runs
    )
    return Table("Models", (Column("Run"), Column("Model"), *map(Column, costs)), rows, name="models")
