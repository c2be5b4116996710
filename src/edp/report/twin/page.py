"""The page of a twin: one offline HTML file of its free runs."""

from __future__ import annotations

from pathlib import Path

from edp.evaluation.free_run_file import PARTS
from edp.report.common.page import Page, Section, Subsection
from edp.report.common.provenance import provenance_rows
from edp.report.twin import facts as words
from edp.report.twin.charts import twin_charts
from edp.report.twin.facts import FreeRunFacts, read_free_runs


def build_twin_report(run_folder: str | Path, output: str | Path | None = None, title: str | None = None) -> Path:
    """Write the page of a twin as one HTML file that opens with no network.

    Args:
        run_folder: folder of `edp twin`, or one in it that `edp evaluate` wrote.
        output: path of the page; ``report.html`` in the folder by default.
        title: title of the page; the folder name by default.

    Returns:
        The file written.

    Raises:
        StorageError: the folder cannot be read, or the page cannot be written.
    """
    target = Path(output) if output is not None else Path(run_folder) / "report.html"
    return build_twin_page(read_free_runs(run_folder), title).write(target)


def build_twin_page(facts: FreeRunFacts, title: str | None = None) -> Page:
    """Build the page of free-run simulations."""
    moments = facts.steps.moments if facts.steps else 0
    charts = {chart.name: chart for chart in twin_charts(facts)}
    tables = words.free_run_tables(facts)
    chart, table = charts.get, tables.get
    return Page(
        title=title or facts.title,
        kind="free runs",
        about=["twin", "free runs"],
        headline=words.headline(facts),
        verdict=words.verdict(facts),
        tiles=words.tiles(facts),
        sections=[
            Section(
                "runs",
                "Free runs",
                [
                    "Measured up to the left edge, on the commands alone from there on. The band is the interval of "
                    "each answer, calibrated on free runs that the fit had not seen; it grows with the horizon.",
                    *(Subsection([chart(f"runs_{part}")], part.capitalize()) for part in PARTS),
                ],
            ),
            Section(
                "horizon",
                "Error by horizon",
                [
                    "Mean absolute error over all free runs, each kind of channel in its own unit; dotted: half width "
                    "of the interval.",
                    chart("horizon"),
                    table("intervals"),
                    # Models have no common error if their units differ.
                    table("actuators") or table("models"),
                ],
            ),
            Section(
                "steps",
                "Step responses",
                [
                    "What the twin would do if one command jumped upwards by half of its range while all others "
                    "stayed: the difference between two free runs, from "
                    f"{moments} moments of recordings that trained nothing. It is the twin's "
                    "answer, not a measured one.",
                    chart("steps"),
                ],
            ),
            Section(
                "situations",
                "End stops and idling",
                [
                    "At an end stop: within 1 % of the stroke. At rest: slower than 1 % of the fastest velocity, at no "
                    "stop. For pressures an actuator at a stop, all of them at rest, and the others. Stroke errors are "
                    "those of all horizons together.",
                    table("situations"),
                ],
            ),
            Section("recordings", "Recordings", [table("driving"), table("recordings")]),
            Section(
                "ahead",
                "A few ticks ahead",
                [
                    "Measured up to a tick, then told the commands in between: what a predictive controller needs. A "
                    "look-ahead predictor is not told them.",
                    table("ahead"),
                    table("beside"),
                ],
            ),
            Section(
                "candidates",
                "Candidates",
                [
                    "Formulations that were fitted to the training recordings. Errors are those of velocities and "
                    "strokes at each time, over the static map's on the same free runs (geometric mean).",
                    table("candidates"),
                ],
            ),
        ],
        provenance=provenance_rows(facts.provenance),
    )
