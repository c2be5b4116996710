"""The page of closed loops: one offline HTML file with the side view of the first loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.report.animation.page import animation_parts
from edp.report.common.templates import template
from edp.report.control.charts import control_charts
from edp.report.control.facts import ControlFacts, event_sheet, loop_sheet, solver_sheet, tiles, verdict
from edp.report.run.page import shown
from edp.storage import write_bytes
from edp.wording import unbroken


def write_control_page(facts: ControlFacts, target: str | Path) -> Path:
    """Write the page of loops.

    Raises:
        StorageError: the page cannot be written.
    """
    write_bytes(Path(target), render(facts).encode("utf-8", "replace"))
    return Path(target)


def render(facts: ControlFacts) -> str:
    """The page's text."""
    events = event_sheet(facts)
    context: dict[str, Any] = {
        "title": facts.title,
        "headline": unbroken(facts.content["sentence"]),
        "verdict": verdict(facts),
        "tiles": tiles(facts),
        "loops": loop_sheet(facts),
        "events": events if events.rows else None,
        "solver": solver_sheet(facts),
        "first": facts.loops[0]["name"],
        "side": animation_parts(facts.scene),
        "provenance": facts.provenance,
        **shown(control_charts(facts)),
    }
    return template("control.html.jinja").render(**context)
