"""The page of a fleet: one offline HTML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edp import __version__
from edp.report.common.chart import BLUE, MUTED, Bars, Chart, ChartAxis, DataSeries, GuideLine, Mark, Panel
from edp.report.common.templates import template
from edp.report.fleet.facts import FleetFacts, failed_sheet, headline, machine_sheet, tiles, verdict, worst_sheet
from edp.report.run.page import shown
from edp.storage import write_bytes
from edp.wording import unbroken

BINS = 24


def write_fleet_page(facts: FleetFacts, target: str | Path) -> Path:
    """Write the page of a fleet.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), render(facts).encode("utf-8", "replace"))
    return Path(target)


def render(facts: FleetFacts) -> str:
    """The page's text."""
    report, network = facts.report, facts.report.network
    return template("fleet.html.jinja").render(
        title=facts.title,
        network=network.label,
        headline=unbroken(headline(facts)),
        verdict=verdict(facts),
        tiles=tiles(facts),
        worst=worst_sheet(facts).table() if facts.rows else None,
        machines=machine_sheet(facts).table() if facts.rows else None,
        failed=failed_sheet(facts).table() if facts.failed else None,
        provenance=[
            ("Network", f"{network.path} ({network.weights})"),
            ("Store", report.store),
            ("Deltas", report.deltas or "none"),
            ("Monitor", report.monitor or "none"),
            ("EDP", __version__),
        ],
        **shown(fleet_charts(facts) if facts.rows else []),
    )


def fleet_charts(facts: FleetFacts) -> list[Chart]:
    """Every figure of the page: ``errors`` and ``drift``."""
    drawn = [errors_chart(facts)]
    return [*drawn, drift_chart(facts)] if any(row.drift is not None for row in facts.rows) else drawn


def errors_chart(facts: FleetFacts) -> Chart:
    """How many machines have which error."""
    counts, edges = np.histogram([row.mae for row in facts.rows], bins=BINS)
    middles = [float(value) for value in (edges[:-1] + edges[1:]) / 2]
    bars: Mark = Bars(
        positions=middles, values=[float(count) for count in counts], colours=[BLUE] * len(counts), width=0.9,
        hover="{y:.0f} machines",
    )  # fmt: skip
    panel = Panel(
        (bars, GuideLine(x=facts.median, dash="dash")),
        ChartAxis(f"Error [{facts.unit}]"),
        ChartAxis("Machines", from_zero=True),
    )
    return Chart("errors", (panel,), height=320, legend="none")


def drift_chart(facts: FleetFacts) -> Chart:
    """Error against drift, a point a machine."""
    marks: list[Mark] = []
    for drifts, colour, name in ((False, BLUE, "steady"), (True, MUTED[0], "drifts")):
        rows = [row for row in facts.rows if row.drift is not None and row.drifts is drifts]
        if rows:
            marks.append(
                DataSeries(
                    x=[float(row.drift or 0.0) for row in rows], y=[row.mae for row in rows], name=name, colour=colour,
                    symbol="circle", labels=[row.name for row in rows], hover="{label}: {y:.4g}",
                )
            )  # fmt: skip
    panel = Panel(
        (*marks, GuideLine(x=1.0)),
        ChartAxis("Error of the second half over the first"),
        ChartAxis(f"Error [{facts.unit}]", from_zero=True),
    )
    return Chart("drift", (panel,), height=380)
