"""Resource limits of the controller stated for a run, and their use by its network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any


def budget_name(footprint: Mapping[str, Any] | None) -> str:
    """Return the name of the stated controller in a run's ``footprint.json``; empty without one."""
    # Here, since pages are also written where torch cannot be imported, which this module needs.
    from edp.evaluation.controller import Budget

    budget = (footprint or {}).get("budget")
    # Earlier versions held every run against the thesis's controller.
    return str(budget.get("name") or "") if isinstance(budget, Mapping) and budget != asdict(Budget()) else ""


def budget_rows(footprint: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
    """Return the verdict by resource against the stated controller; empty without one."""
    return list((footprint or {}).get("verdict", ())) if budget_name(footprint) else []
