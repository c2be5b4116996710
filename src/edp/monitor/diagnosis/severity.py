"""Severity of an alarm: note, warning or stop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause

Severity = Literal["note", "warning", "stop"]
SMALL, LARGE = 0.34, 0.67
"""Boundaries of the severity grades, as positions among the simulated sizes. The first of four sizes is a note; the
upper ones may be a reason to stop.
"""
ENOUGH = 0.5
"""Total probability of severe causes above which the machine should stop."""


def severity(causes: Sequence[Cause]) -> Severity:
    """Return the severity of an alarm with these causes, the most probable first.

    `stop`: faults by which a load may fall or a movement may not stop are more likely than not, and large. `note`: the
    most likely cause is hardly larger than what can be seen at all. All else, and what has no name, is a warning.
    """
    grave = sum(cause.probability for cause in causes if cause.grave and _grade(cause) >= LARGE)
    if grave >= ENOUGH:
        return "stop"
    if causes and causes[0].kind != NONE_OF_THESE and _grade(causes[0]) < SMALL:
        return "note"
    return "warning"


def _grade(cause: Cause) -> float:
    # A fault without sizes is there whole.
    return 1.0 if cause.grade is None else cause.grade
