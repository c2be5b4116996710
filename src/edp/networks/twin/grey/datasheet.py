"""Datasheet of a grey box: every fitted parameter, and the inertia of each actuator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.bodies import forces_by_moments, moments_of
from edp.networks.twin.grey.known_linkage import GIGA
from edp.networks.twin.grey.parameters import ParameterTable
from edp.networks.twin.parameters import UNEXCITED, DatasheetRow, Parameter, datasheet_rows, posterior_deviations

Doubles = NDArray[np.float64]
BASIS = (
    "95 % intervals from the Gauss-Newton information of the last rounds of the fit and the deviations that are "
    "plausible for such a machine; errors of rows that lie apart are taken as independent, so they are approximate"
)


def datasheet(table: ParameterTable, values: Doubles, information: Doubles) -> tuple[DatasheetRow, ...]:
    """Return one row per fitted parameter, and one row for the inertia of each actuator, in SI units.

    Args:
        table: parameters of the grey box.
        values: their values in units of the grey box ``(parameter,)``.
        information: inverse covariance of the coordinates by the data alone, in prior standard deviations
            ``(parameter, parameter)``.
    """
    rows = datasheet_rows(table.numbers, values, posterior_deviations(information))
    inertias = _polynomial_inertias if table.front is None else _body_inertias
    covariance: Doubles = np.asarray(np.linalg.inv(information + np.eye(len(values))), np.float64)
    return (*rows, *inertias(table, values, covariance))


def _polynomial_inertias(table: ParameterTable, values: Doubles, covariance: Doubles) -> list[DatasheetRow]:
    """Return one row for the inertia of each actuator with the others in steady state, at the middle of all strokes.

    It is the sum of squares of its row of the root, whose first coefficients are the root there; its interval follows
    from theirs and their covariance.
    """
    rows, first = [], table.inertia_at
    for a, first_number in enumerate(table.actuator_at):
        own = first + table.inertia_terms * np.arange(a + 1)
        first = int(own[-1]) + table.inertia_terms
        root = table.numbers[own[0]]
        value, slope = float(values[own] @ values[own]), 2.0 * values[own] * table.width[own]
        unit = root.unit.replace("kg^0.5", "kg").replace(" m", " m^2")
        name = f"inertia_{table.numbers[first_number].element}"
        inertia = Parameter("load", name, unit, root.factor**2, value, positive=False)
        rows.append(_inertia_row(inertia, slope, covariance[np.ix_(own, own)]))
    return rows


def _body_inertias(table: ParameterTable, values: Doubles, covariance: Doubles) -> list[DatasheetRow]:
    """Return the inertia rows of a known linkage, at the middle of the strokes of its machine."""
    span, n = slice(table.inertia_at, table.potential_at), len(table.actuator_at)
    joints = table.linkage[at.JOINTS :].reshape(at.BODIES, at.JOINT_VALUES)
    strokes, resting = np.zeros((1, n)), np.zeros((1, n))
    which = joints[:, at.ACTUATOR].astype(int)
    strokes[0, which] = 0.5 * (joints[:, at.KNOT] + joints[:, -at.KNOT_VALUES])
    moments = moments_of(values, table.inertia_at, table.linkage)
    by_coordinate = moments.slopes * table.priors.slopes(values)[span]
    at_rest, rows = forces_by_moments(strokes, resting, resting, table.linkage), []
    for i, first_number in enumerate(table.actuator_at):
        moved = forces_by_moments(strokes, resting, np.eye(n)[i : i + 1], table.linkage)
        parts = (moved - at_rest)[0, i]
        name = f"inertia_{table.numbers[first_number].element}"
        inertia = Parameter("load", name, "kg", GIGA, float(parts @ moments.values), positive=False)
        rows.append(_inertia_row(inertia, parts @ by_coordinate, covariance[span, span]))
    return rows


def _inertia_row(inertia: Parameter, slope: Doubles, covariance: Doubles) -> DatasheetRow:
    """Return the row of an actuator's inertia, from its derivatives by scaled coordinates and their covariance."""
    deviation = float(np.sqrt(slope @ covariance @ slope))
    row = inertia.row(inertia.nominal, deviation, deviation < UNEXCITED * float(np.sqrt(slope @ slope)))
    return replace(row, low=max(row.low, 0.0))
