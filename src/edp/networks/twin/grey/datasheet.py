"""The datasheet of a machine: every number of its grey box with unit and interval, as far as the data tell it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey.numbers import NumberTable

Doubles = NDArray[np.float64]
NORMAL = 1.96
"""Deviations on either side of an interval of 95 % of a normal distribution."""
UNEXCITED = 0.7
"""Share of the deviation that was plausible before: where more is left, the data say little about a number."""
BASIS = (
    "95 % intervals from the Gauss-Newton information of the last round of the fit and the deviations that are "
    "plausible for such a machine; errors of rows that lie apart are taken as independent, so they are approximate"
)


def datasheet(table: NumberTable, values: Doubles, information: Doubles) -> list[dict[str, Any]]:
    """A row for each number that is fitted, SI units.

    Args:
        table: of the grey box.
        values: of its numbers, in its own units.
        information: inverse covariance of the coordinates by the data alone, each in plausible deviations
            ``(number, number)``.

    Returns:
        Element, name, unit, value, low and high end of the interval, and whether the data excite it.
    """
    left = np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(values)))))
    rows = []
    for number, value, deviation in zip(table.numbers, values, left, strict=True):
        if number.width == 0.0:
            continue
        reach = NORMAL * deviation * number.width
        ends = value * np.exp([-reach, reach]) if number.positive else value + np.array([-reach, reach])
        low, high = (float(end * number.factor) for end in ends)
        rows.append(
            {
                "element": number.element,
                "name": number.name,
                "unit": number.unit,
                "value": float(value * number.factor),
                "low": low,
                "high": high,
                "excited": bool(deviation < UNEXCITED),
            }
        )
    return rows


def datasheet_text(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table for readers."""
    width = max(len(f"{row['element']}.{row['name']}") for row in rows)
    lines = [
        BASIS + ".",
        "A number in brackets is one that the data do not excite: what was plausible before stands.",
        "",
    ]
    for row in rows:
        label = f"{row['element']}.{row['name']}".ljust(width)
        value = f"{row['value']:.4g}" if row["excited"] else f"({row['value']:.4g})"
        lines.append(f"{label}  {value:>12}  {row['low']:>10.3g} to {row['high']:<10.3g}  {row['unit']}")
    return "\n".join(lines) + "\n"
