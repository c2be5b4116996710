"""The sessions of the monitor's benchmark, full or quick: which are simulated, and their names."""

from __future__ import annotations

from edp.monitor.residuals.base import SideBySide
from monitor_sessions import COUNTS, NUISANCES, plans_of, session_names, session_plans, write_sessions
from monitor_watching import Plan

QUICK_COUNTS = {"training": (16, 0), "test": (6, 1)}
"""Healthy sessions, and those of each nuisance set."""


QUICK_SECONDS, QUICK_HOURS = 60.0, 0.1


QUICK_FAULTS = 12


def write_training(plan: Plan, side_by_side: SideBySide) -> None:
    """Simulate the sessions that are fitted to, where they are missing."""
    if plan.quick:
        healthy, _ = QUICK_COUNTS["training"]
        plans = plans_of("training", {"healthy": healthy, "faulty": 0, "nuisance": 0}, QUICK_SECONDS)
    else:
        plans = session_plans("training", "healthy", min(plan.sessions, COUNTS["training"]["healthy"]))
    write_sessions(plans, plan.data / "training", side_by_side)


def write_test(plan: Plan, side_by_side: SideBySide) -> None:
    """Simulate the sessions that are judged, where they are missing."""
    if not plan.quick:
        write_sessions(plans_of("test", COUNTS["test"]), plan.data / "test", side_by_side)
        return
    # With the seeds of the validation part: those of the test are for the full form alone.
    healthy, nuisance = QUICK_COUNTS["test"]
    plans = plans_of("validation", {"healthy": healthy, "faulty": 0, "nuisance": nuisance}, QUICK_SECONDS)
    faults = plans_of("validation", {"healthy": 0, "faulty": 1, "nuisance": 0}, QUICK_SECONDS)
    step = len(faults) // QUICK_FAULTS
    write_sessions([*plans, *faults[step - 1 :: step]], plan.data / "test", side_by_side)


def test_names(plan: Plan) -> dict[str, list[str]]:
    """Names of the test sessions by group; groups without any are left out."""
    groups = ("healthy", "faulty", *NUISANCES)
    if plan.quick:
        names = {group: session_names(plan.data / "test", group) for group in groups}
    else:
        counts = {group: COUNTS["test"].get(group, COUNTS["test"]["nuisance"]) for group in groups}
        names = {group: [one.name for one in session_plans("test", group, counts[group])] for group in groups}
    return {group: some for group, some in names.items() if some}
