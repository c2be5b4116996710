"""Datasheet of a machine: every grey-box parameter with unit and confidence interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.bodies import forces_by_moments, moments_of
from edp.networks.twin.grey.known_linkage import GIGA
from edp.networks.twin.grey.parameters import ParameterTable
from edp.storage.reading import Table
from edp.wording import typed

Doubles = NDArray[np.float64]
NORMAL = 1.96
"""Deviations on either side of an interval of 95 % of a normal distribution."""
UNEXCITED = 0.7
"""Share of the deviation that was plausible before: where more is left, the data say little about a number."""
BASIS = (
    "95 % intervals from the Gauss-Newton information of the last rounds of the fit and the deviations that are "
    "plausible for such a machine; errors of rows that lie apart are taken as independent, so they are approximate"
)


def datasheet(table: ParameterTable, values: Doubles, information: Doubles) -> list[dict[str, object]]:
    """Return one row per fitted parameter, and one for the derived inertia of each actuator; SI units.

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
    return rows + _inertias(table, values, information)


def _inertias(table: ParameterTable, values: Doubles, information: Doubles) -> list[dict[str, object]]:
    """Return one row for the inertia of each actuator with the others at rest, at the middle of all strokes.

    It is the sum of squares of its row of the root, whose first coefficients are the root there; its interval follows
    from theirs and their covariance.
    """
    covariance: Doubles = np.asarray(np.linalg.inv(information + np.eye(len(values))), np.float64)
    rows, first = [], table.inertia_at
    if table.front is not None:
        return _body_inertias(table, values, covariance)
    for a, first_number in enumerate(table.actuator_at):
        own = first + table.inertia_terms * np.arange(a + 1)
        first = int(own[-1]) + table.inertia_terms
        root = table.numbers[own[0]]
        value, slope = float(values[own] @ values[own]), 2.0 * values[own] * table.width[own]
        unit = root.unit.replace("kg^0.5", "kg").replace(" m", " m^2")
        of = table.numbers[first_number].element
        rows.append(_inertia_row(of, unit, root.factor**2, value, slope, covariance[np.ix_(own, own)]))
    return rows


def _body_inertias(table: ParameterTable, values: Doubles, covariance: Doubles) -> list[dict[str, object]]:
    """Return the inertia rows of a known linkage, at the middle of the strokes of its machine."""
    span, n = slice(table.inertia_at, table.potential_at), len(table.actuator_at)
    joints = table.linkage[at.JOINTS :].reshape(at.BODIES, at.JOINT_VALUES)
    strokes, resting = np.zeros((1, n)), np.zeros((1, n))
    which = joints[:, at.ACTUATOR].astype(int)
    strokes[0, which] = 0.5 * (joints[:, at.KNOT] + joints[:, -at.KNOT_VALUES])
    moments = moments_of(values, table.inertia_at, table.linkage)
    by_coordinate = moments.slopes * np.where(table.positive[span], values[span] * table.width[span], table.width[span])
    at_rest, rows = forces_by_moments(strokes, resting, resting, table.linkage), []
    for i, first_number in enumerate(table.actuator_at):
        moved = forces_by_moments(strokes, resting, np.eye(n)[i : i + 1], table.linkage)
        parts = (moved - at_rest)[0, i]
        of = table.numbers[first_number].element
        slope = parts @ by_coordinate
        rows.append(_inertia_row(of, "kg", GIGA, float(parts @ moments.values), slope, covariance[span, span]))
    return rows


def _inertia_row(
    of: str, unit: str, factor: float, value: float, slope: Doubles, covariance: Doubles
) -> dict[str, object]:
    """Return the row of an actuator's inertia, from its derivative by scaled coordinates and their covariance."""
    deviation = float(np.sqrt(slope @ covariance @ slope))
    reach = NORMAL * deviation
    return {
        "element": "load",
        "name": f"inertia_{of}",
        "unit": unit,
        "value": value * factor,
        "low": max(value - reach, 0.0) * factor,
        "high": (value + reach) * factor,
        "excited": bool(deviation < UNEXCITED * float(np.sqrt(slope @ slope))),
    }


def datasheet_text(rows: Sequence[Table], basis: str = BASIS) -> str:
    """Format the rows as a table for readers, headed by the basis of the intervals."""
    width = max(len(f"{row['element']}.{row['name']}") for row in rows)
    lines = [
        basis + ".",
        "A number in brackets is one that the data do not excite: what was plausible before stands.",
        "",
    ]
    for row in rows:
        label = f"{row['element']}.{row['name']}".ljust(width)
        value = typed(row["value"]) if row["excited"] else f"({typed(row['value'])})"
        lines.append(f"{label}  {value:>12}  {row['low']:>10.3g} to {row['high']:<10.3g}  {row['unit']}")
    return "\n".join(lines) + "\n"
