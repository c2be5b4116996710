"""Phase 6 of a study: its table, in the form of the thesis's Table 4.9, and what it says in short."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edp.report.search.facts import StudyFacts, of_phase, real
from edp.table import Column, Table, figures
from edp.wording import number, percent


@of_phase("compression", None)
def smaller_table(study: StudyFacts, facts: Mapping[str, Any]) -> Table | None:
    """Every network in every number format: what it takes, its error, and whether it fits; the front is marked."""
    rows = tuple(
        (
            str(row["name"]),
            str(row["recipe"]),
            real(row["resource_usage"]["parameters"]),
            real(row["resource_usage"]["parameter_bytes"]),
            real(row["resource_usage"]["cycles"][2]),
            real(row["resource_usage"]["macs_tick"]),
            _mean(row["scores"], "mae"),
            _mean(row["scores"], "composite"),
            100 * (real(row["error"]) - 1),
            "chosen" if index == facts["chosen"] else ", ".join(row["over"]) or "fits",
        )
        for index, row in enumerate(facts.get("rows", ()))
    )
    count = figures([], decimals=0)
    columns = (
        Column("Network"),
        Column("Made by", is_text=True),
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
    return Table(caption, columns, rows, frozenset(map(int, facts.get("front", ()))), name="compression")


def _mean(scores: Mapping[str, Mapping[str, Any]], name: str) -> float:
    values = [real(entry[name]) for entry in scores.values()]
    return sum(values) / len(values)


@of_phase("compression", "")
def chosen_words(study: StudyFacts, facts: Mapping[str, Any]) -> str:
    """What was chosen for the controller, and what the second sealed test set says of it."""
    if not facts["on"]:
        return ""
    if facts["chosen"] is None:
        return f"No network fits the budget '{facts['budget']['name']}'."
    row = facts["rows"][int(facts["chosen"])]
    size = number(real(row["resource_usage"]["parameter_bytes"]) / 1000, 1)
    text = f"For the controller {row['name']} is chosen, with {size} kB of parameters"
    if facts["held_out_test"] is None:
        return f"{text}; it could not be judged on the second sealed test set."
    change = percent(real(facts["held_out_test"]["error"]) - 1, signed=True)
    return f"{text}; on the second sealed test set its error is {change} against the teacher's."
