"""One rule for percentages in headlines, first lines, tables of the terminal and pages: `edp.wording.percent`."""

import math
import re
from pathlib import Path

import pytest

from edp.evaluation.guard import ErrorVerdict
from edp.wording import percent, percent_interval

SOURCE = Path(__file__).parents[2] / "src/edp"
ROOMS = ("cli", "evaluation", "report", "stats", "workflows")
"""Rooms that word results. Logs, screening and monitor state shares of their own, such as 0.02 % of the time."""
FORMATTED = re.compile(r"\{[^{}]*:[^{}]*(?:%\}|[0-9]f\} ?%)")
"""A number that an f-string formats as a percentage by itself."""
SETTINGS = {
    "report/run/charts.py": "labels of axes and of coverages that are settings",
    "report/coverage/charts.py": "labels of cells under the pointer, most of which hold less than 0.1 %",
}
"""Files whose percentages are settings and labels of axes, not results."""


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.38, "38 %"), (0.3804, "38 %"), (0.0995, "10 %"), (0.0994, "9.9 %"), (0.031, "3.1 %"), (0.0, "0.0 %"),
        (-0.0001, "0.0 %"), (-0.2, "−20 %"), (12.5, "1,250 %"), (None, "–"), (math.nan, "–"), (1e300, "1e+302 %"),
    ],
)  # fmt: skip
def test_one_decimal_below_ten_percent_and_none_above(share, text):
    assert percent(share) == text


def test_a_verdict_states_the_same_percentages_as_every_other_place():
    better = ErrorVerdict("Ridge", 1 - 1 / 0.62, (), interval=(-0.4, -0.05), recordings=5)
    assert "has 38 % less error than Ridge" in better.sentence()
    assert f"over 5 recordings: {percent_interval(-0.4, -0.05)})" in better.sentence()
    worse = ErrorVerdict("Ridge", 0.3801, ())
    assert f"Ridge has {percent(0.3801)} less error" in worse.sentence()


@pytest.mark.parametrize("room", ROOMS)
def test_no_room_that_words_results_rounds_percentages_by_itself(room):
    faults = []
    for file in sorted((SOURCE / room).rglob("*.py")):
        name = file.relative_to(SOURCE).as_posix()
        lines = file.read_text(encoding="utf-8").splitlines()
        found = [f"{name}:{number}" for number, line in enumerate(lines, 1)
                 if FORMATTED.search(line) and "hover=" not in line]  # fmt: skip
        if name in SETTINGS:
            assert found, f"{name} needs no exception any more"
        else:
            faults += found
    assert faults == []
