"""Errors of a network of many machines on unseen machines: tables of ``foundation.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edp.report.common.sheets import Column, Sheet, Value, figures, plainly
from edp.wording import figure


def parts_sheet(foundation: Mapping[str, Any]) -> Sheet:
    """Machines, recordings and minutes of each part."""
    heads = ("machines", "recordings", "minutes")
    rows = tuple((part, *(facts[key] for key in heads)) for part, facts in foundation["data"].items())
    columns = (Column("Part"), *(Column(head.capitalize(), show=_short) for head in heads))
    return Sheet("parts", f"{foundation['label']} over many machines", columns, rows)


def contexts_sheet(foundation: Mapping[str, Any], unit: str = "report units") -> Sheet:
    """Error by the time since the state was reset, always on the same ticks."""
    unseen = foundation["unseen"]
    rows = tuple(_context(row) for row in unseen["contexts"])
    columns = (
        Column("Since reset", "s", _short),
        Column("MAE", unit, figures([row[1] for row in rows], decimals=3)),
        Column("Change", "%", figures([row[2] for row in rows], signed=True, decimals=1)),
        Column("95 %", "+- %", figures([row[3] for row in rows], decimals=1)),
    )
    caption = (
        f"Machines that were never seen ({len(unseen['machines'])}), k = {foundation['horizon']}: error by the time "
        f"since the state was reset, {unseen['ticks']} ticks"
    )
    return Sheet("contexts", caption, columns, rows)


def _short(value: Value) -> str:
    return figure(value) if isinstance(value, int | float) else plainly(value)


def _context(row: Mapping[str, Any]) -> tuple[Value, ...]:
    spread = row["change_error"]
    return row["seconds"], row["mae"], 100 * row["change"], None if spread is None else 196 * spread


def machines_sheet(foundation: Mapping[str, Any], unit: str = "report units") -> Sheet:
    """Each machine that tests, the hardest first."""
    each = sorted(foundation["unseen"]["machines"].items(), key=lambda entry: -entry[1])
    columns = (Column("Machine"), Column("MAE", unit, figures([mae for _, mae in each])))
    return Sheet("machines", "Machines that were never seen, the hardest first", columns, tuple(each))
