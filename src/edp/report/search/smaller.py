"""Phase 6 of a study: a table in the form of the thesis's Table 4.9, and a short result."""

from __future__ import annotations

from edp.evaluation.compression import Scores
from edp.evaluation.study import StudyFile
from edp.evaluation.study_facts import SmallerFacts
from edp.report.search.facts import require_phase
from edp.table import Column, Table, figures
from edp.wording import number, percent


@require_phase(SmallerFacts, None)
def smaller_table(study: StudyFile, facts: SmallerFacts) -> Table | None:
    """Return every network in every number format: cost, error, and whether it fits; the front is marked."""
    rows = tuple(
        (
            row.name,
            row.recipe,
            float(row.resource_usage.parameters),
            float(row.resource_usage.parameter_bytes),
            float(row.resource_usage.cycles[2]),
            float(row.resource_usage.macs_tick),
            _mean(row.scores, "mae"),
            _mean(row.scores, "composite"),
            100 * (row.error - 1),
            "chosen" if index == facts.chosen else ", ".join(row.over) or "fits",
        )
        for index, row in enumerate(facts.rows)
    )
    count = figures([], decimals=0)
    columns = (
        Column("Network"),
        Column("Made by"),
        Column("Parameters", "", count),
        Column("Parameters", "bytes", count),
        Column("Cycles", "per tick, high", count),
        Column("MACs", "per tick", count),
        Column("MAE", study.unit, figures([row[6] for row in rows])),
        Column("Composite", study.unit, figures([row[7] for row in rows])),
        Column("Change", "% of the teacher's MAE", figures([], signed=True, decimals=1)),
        Column("Budget", is_text=True),
    )
    caption = "Smaller networks of the teacher on development sessions that do not train; marked: the front"
    return Table(caption, columns, rows, frozenset(facts.front), name="compression")


def _mean(scores: Scores, name: str) -> float:
    return sum(by_score[name] for by_score in scores.values()) / len(scores)


@require_phase(SmallerFacts, "")
def describe_choice(study: StudyFile, facts: SmallerFacts) -> str:
    """State the choice for the controller, and its error on the second sealed test set."""
    if not facts.on or facts.budget is None:
        return ""
    if facts.chosen is None:
        return f"No network fits the budget '{facts.budget.name}'."
    row = facts.rows[facts.chosen]
    size = number(row.resource_usage.parameter_bytes / 1000, 1)
    text = f"For the controller {row.name} is chosen, with {size} kB of parameters"
    if facts.held_out_test is None:
        return f"{text}; it could not be judged on the second sealed test set."
    change = percent(facts.held_out_test.error - 1, signed=True)
    return f"{text}; on the second sealed test set its error is {change} against the teacher's."
