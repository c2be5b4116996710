"""The page of closed loops: one offline HTML file with the side view of the first loop."""

from __future__ import annotations

from edp.report.animation.page import side_view
from edp.report.common.page import Page, Section
from edp.report.control.charts import control_charts
from edp.report.control.facts import ControlFacts, event_table, loop_table, solver_table, tiles, verdict


def build_control_page(facts: ControlFacts) -> Page:
    """Return the page of loops."""
    charts = {chart.name: chart for chart in control_charts(facts)}
    return Page(
        title=facts.title,
        kind="closed loops",
        about=["closed loops"],
        headline=facts.content.sentence,
        verdict=verdict(facts),
        tiles=tiles(facts),
        sections=[
            Section(
                "paths",
                "Path",
                [
                    "The tip from the side; axes have scales of their own, so that millimetres are seen.",
                    charts["path"],
                ],
            ),
            Section(
                "error",
                "Errors",
                [
                    "Distance of the tip to where the reference is at that time, and what each cylinder contributes.",
                    charts["errors"],
                    charts["strokes"],
                ],
            ),
            Section("side", "Side view", [f"Loop {facts.content.loops[0].name}.", side_view(facts.scene)]),
            Section("lever", "Levers", [charts["levers"]]),
            Section("loops", "Loops", [loop_table(facts), event_table(facts)]),
            Section(
                "steps",
                "Solver",
                [
                    "Time of a step of the controller on the computer that ran the loop.",
                    charts["solver"],
                    solver_table(facts),
                ],
            ),
        ],
        provenance=facts.provenance,
        styles=("page.css", "side_view.css"),
    )
