"""Closed loops as a reader sees them: sentence, key figures, tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from edp.errors import count_of
from edp.recording import Recording
from edp.report.animation.page import Scene
from edp.table import Column, Table, Value, figures
from edp.wording import MISSING, number

if TYPE_CHECKING:
    from edp.control.run_file import ControlFile


@dataclass(frozen=True, eq=False)
class ControlFacts:
    """Loops of one controller on one task.

    Attributes:
        title: title of the page.
        content: content of ``results.json``.
        recordings: recordings of the loops, in order: see `edp.control.loop.LoopResult`.
        solve_us: times of the controller's steps, microseconds, in the order of the recordings.
        scene: side view of the first loop.
        provenance: name and text of where it comes from.
    """

    title: str
    content: ControlFile
    recordings: Sequence[Recording]
    solve_us: Sequence[Any]
    scene: Scene
    provenance: Sequence[tuple[str, str]] = ()


def verdict(facts: ControlFacts) -> list[str]:
    """Describe the loops in sentences after the headline."""
    content, summary = facts.content, facts.content.summary
    lines = [
        f"{count_of(len(content.loops), 'loop')} of the task {content.task['kind']} on {content.plant}.",
        "The position error is the distance of the tip to where the reference is at that time; the path error is its "
        "distance to the nearest point of the path, which alone would reward standing still.",
    ]
    if summary.violations:
        lines.append(f"Limits were violated at {count_of(summary.violations, 'tick')}.")
    if summary.missed:
        lines.append(f"The controller had no answer at {count_of(summary.missed, 'tick')} and gave the safe command.")
    return lines


def tiles(facts: ControlFacts) -> list[tuple[str, str, str]]:
    """Return key figures: value, unit, description."""
    summary = facts.content.summary
    rows = [
        (number(summary.position_rms_mm), "mm", "position error of the tip (rms, mean over the loops)"),
        (number(summary.position_worst_mm), "mm", "position error in the worst loop (rms)"),
        (number(summary.path_rms_mm), "mm", "distance to the path (rms, mean over the loops)"),
        (number(summary.attitude_rms_deg), "deg", "attitude error of the bucket (rms)"),
        (number(summary.lever_travel), "", "lever travel, in full positions"),
        (number(summary.solve_us_median, 0), "µs", "median time of a step of the controller"),
    ]
    if summary.energy_kj is not None:
        rows.insert(4, (number(summary.energy_kj, 0), "kJ", "hydraulic energy of the pumps"))
    return rows


def loop_table(facts: ControlFacts) -> Table:
    """Return one row of figures per loop."""
    heads = (
        ("Position rms", "mm", "position_rms_mm"),
        ("p95", "mm", "position_p95_mm"),
        ("max", "mm", "position_max_mm"),
        ("Path rms", "mm", "path_rms_mm"),
        ("max", "mm", "path_max_mm"),
        ("Attitude rms", "deg", "attitude_rms_deg"),
        ("Arrived after", "s", "arrived_s"),
        ("Energy", "kJ", "energy_kj"),
        ("Lever travel", "", "lever_travel"),
    )
    rows: list[tuple[Value, ...]] = []
    for loop in facts.content.loops:
        score = loop.score
        violated = ", ".join(f"{name} {ticks}" for name, ticks in score.violations.items() if ticks) or MISSING
        rows.append((loop.name, *(getattr(score, key) for _, _, key in heads), violated))
    shown = [Column(title, unit, figures(row[1 + n] for row in rows)) for n, (title, unit, _) in enumerate(heads)]
    return Table("Loops", (Column("Loop"), *shown, Column("Violated, ticks", is_text=True)), tuple(rows), name="loops")


def event_table(facts: ControlFacts) -> Table:
    """Return the events that controllers logged."""
    rows: list[tuple[Value, ...]] = [
        (loop.name, event.tick, event.ticks, event.text) for loop in facts.content.loops for event in loop.events
    ]
    whole = figures([], decimals=0)
    heads = (Column("Loop"), Column("From tick", "", whole), Column("Ticks", "", whole), Column("Event", is_text=True))
    return Table("Safe commands", heads, tuple(rows), name="events")


def solver_table(facts: ControlFacts) -> Table:
    """Return the controller's time per step."""
    rows: list[tuple[Value, ...]] = [
        (loop.name, loop.solve_us.median, loop.solve_us.p99, loop.solve_us.max) for loop in facts.content.loops
    ]
    shown = [Column(name, "µs", figures([], decimals=0)) for name in ("Median", "99 %", "Longest")]
    return Table("Time of a step of the controller", (Column("Loop"), *shown), tuple(rows), name="solver")
