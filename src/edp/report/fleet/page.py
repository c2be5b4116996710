"""The page of a fleet: one offline HTML file."""

from __future__ import annotations

import numpy as np

from edp.report.common.chart import BLUE, MUTED, Bars, Chart, ChartAxis, DataSeries, GuideLine, Mark, Panel
from edp.report.common.page import Page, Section
from edp.report.fleet.facts import FleetFacts, headline, machine_table, tabulate_failures, tiles, verdict, worst_table

BINS = 24


def build_fleet_page(facts: FleetFacts) -> Page:
    """Return the page of a fleet."""
    report, network = facts.report, facts.report.network
    return Page(
        title=facts.title,
        kind="fleet",
        about=["fleet", network.label],
        headline=headline(facts),
        verdict=verdict(facts),
        tiles=tiles(facts),
        sections=[
            Section(
                "worst",
                "The worst, and why",
                [
                    "What departs from the other machines of the fleet. A reason is a pointer, not a proof: look at "
                    "the machine's own report, and at its monitor, before anything is repaired.",
                    worst_table(facts),
                ],
                "The worst",
            ),
            Section(
                "errors",
                "Errors",
                [
                    "Mean absolute error of each machine over its outputs and all ticks after a start-up of one "
                    "window; dashed: the median machine.",
                    errors_chart(facts) if facts.rows else None,
                ],
            ),
            Section(
                "drift",
                "Drift",
                [
                    "The error of the second half of a machine's time over that of the first, by blocks of ten "
                    "seconds. Other work in the second half looks the same as wear: a machine drifts here where the "
                    "difference is larger than chance between blocks.",
                    drift_chart(facts) if any(row.drift is not None for row in facts.rows) else None,
                ],
            ),
            Section(
                "machines",
                "All machines",
                [
                    "Bold: machines that drift, or of which the monitor told a change.",
                    machine_table(facts),
                ],
            ),
            Section("failed", "Not judged", [tabulate_failures(facts)]),
        ],
        provenance=[
            ("Network", f"{network.path} ({network.weights})"),
            ("Store", report.store),
            ("Deltas", report.deltas or "none"),
            ("Monitor", report.monitor or "none"),
            ("EDP", report.edp),
        ],
    )


def errors_chart(facts: FleetFacts) -> Chart:
    """Return how many machines have which error."""
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
    """Return error against drift, one point per machine."""
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
