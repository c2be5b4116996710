"""Figures of a twin whose actuators have different units: each stands alone, for there is no mean over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from edp.report.common.sheets import Column, Sheet, Value
from edp.wording import figure, number


def mixed_units(scores: Mapping[str, Any]) -> bool:
    """Whether velocities of a twin have more than one unit."""
    return bool(scores["velocity_mae"].get("units"))


def actuator_sheet(models: Mapping[str, Mapping[str, Any]]) -> Sheet:
    """A row for each actuator and model: errors of its velocity, and of its stroke by time, with their units."""
    columns = {
        name: [("Velocity MAE", one["velocity_mae"])]
        + [(f"Stroke after {figure(row['at_s'])} s", row) for row in one["stroke_error"]]
        for name, one in models.items()
    }
    return _sheet("actuators", "The twin and its floors, each actuator in its units", columns)


def ahead_by_actuator(models: Mapping[str, Mapping[str, Any]], caption: str) -> Sheet:
    """The same a few ticks ahead of measured ports."""
    columns = {
        name: [("Velocity MAE", one["ahead"]["velocity_mae"]), ("Stroke error", one["ahead"]["stroke_error"])]
        for name, one in models.items()
        if "ahead" in one
    }
    return _sheet("ahead", caption, columns)


def _sheet(name: str, caption: str, columns: Mapping[str, Sequence[tuple[str, Mapping[str, Any]]]]) -> Sheet:
    """Rows by actuator, then model; of each model titles and rows of errors, each by channel."""
    first = next(iter(columns.values()))
    rows: list[tuple[Value, ...]] = []
    for which, velocity in enumerate(first[0][1]["by_channel"]):
        for model, entries in columns.items():
            cells = [_with_unit(row, list(row["by_channel"])[which]) for _, row in entries if row["by_channel"]]
            rows.append((velocity, model, *cells))
    titles = [title for title, row in first if row["by_channel"]]
    heads = tuple(Column(title) for title in ("Actuator", "Model", *titles))
    return Sheet(name, caption, heads, tuple(rows), frozenset(range(0, len(rows), len(columns))))


def actuator_tiles(twin: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Key figures of each actuator: value, unit, what it is."""
    row = twin["stroke_error"][-1] if twin["stroke_error"] else twin["velocity_mae"]
    what = f"error of {{}} after {figure(row['at_s'])} s" if "at_s" in row else "mean absolute error of {}"
    return [(number(value), _unit(row, name), what.format(name)) for name, value in row["by_channel"].items()]


def _with_unit(row: Mapping[str, Any], channel: str) -> str:
    return f"{number(row['by_channel'][channel])} {_unit(row, channel)}".strip()


def _unit(row: Mapping[str, Any], channel: str) -> str:
    return str(row.get("units", {}).get(channel) or row["unit"] or "")
