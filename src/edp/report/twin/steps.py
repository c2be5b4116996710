"""Step responses of a twin: what it would do if one command jumped and the others stayed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from edp.errors import StorageError
from edp.evaluation.scores_file import COUNT, NAME, REAL, SIZE, KeyedObject, Listed, read_shaped
from edp.report.common.chart import Chart, ChartAxis, Control, DataSeries, Mark, Panel, Range, with_unit
from edp.storage.paths import is_file_at
from edp.wording import figure, label_by_name

FILE, COMMAND = "step_response.json", "command"
MOST_PANELS = 6
ANSWER = KeyedObject(
    {"name": NAME, "unit": NAME, **dict.fromkeys(("median", "low", "high"), Listed(REAL))},
    ("name", "unit", "median", "low", "high"),
)
STEP = KeyedObject(
    {"command": NAME, "size": SIZE, "unit": NAME, "answers": Listed(ANSWER)}, ("command", "size", "unit", "answers")
)
SHAPE = KeyedObject(
    {"schema": COUNT, "seconds": Listed(SIZE), "moments": COUNT, "steps": Listed(STEP)},
    ("schema", "seconds", "moments", "steps"),
)


def read_steps(folder: Path) -> Mapping[str, Any]:
    """What `edp twin` or `edp evaluate` wrote of step responses; empty where there is none, as of an older version.

    Raises:
        StorageError: damaged content.
    """
    path = folder / FILE
    if not is_file_at(path):
        return {}
    content: Mapping[str, Any] = read_shaped(path, SHAPE)
    count = len(content["seconds"])
    lines = [
        answer[key] for step in content["steps"] for answer in step["answers"] for key in ("median", "low", "high")
    ]
    if any(len(line) != count for line in lines):
        raise StorageError(f"'{path}' has lines of other lengths than its times; run edp evaluate again")
    return content


def steps_chart(steps: Mapping[str, Any]) -> Chart | None:
    """Response of each answer to a step of the command that is chosen; None where there is none."""
    if not steps.get("steps"):
        return None
    seconds, panels = steps["seconds"], []
    labels = label_by_name(answer["name"] for answer in steps["steps"][0]["answers"])
    for row, first in enumerate(steps["steps"][0]["answers"][:MOST_PANELS]):
        marks: list[Mark] = []
        for step in steps["steps"]:
            answer, when = step["answers"][row], {COMMAND: step["command"]}
            low, high = (np.array(answer[end]) for end in ("low", "high"))
            marks.append(Range(x=seconds, low=low, high=high, name="Middle 80 % of the moments", hover=None, when=when))
            marks.append(DataSeries(x=seconds, y=answer["median"], name="Median", width=1.8, when=when))
        title = with_unit(labels[first["name"]], first["unit"])
        panels.append(Panel(tuple(marks), ChartAxis("Time since the step [s]"), title=title))
    options = tuple(
        (step["command"], f"{step['command']}, step of {figure(step['size'])} {step['unit']}")
        for step in steps["steps"]
    )
    return Chart(
        "steps", tuple(panels), columns=2, choices=(Control(COMMAND, "Command", options),),
        height=80 + 210 * -(-len(panels) // 2),
    )  # fmt: skip
