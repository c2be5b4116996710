"""Initial bodies of a grey-box fit with a known linkage, which balance the measured forces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.bodies import forces_by_moments, moments_of
from edp.networks.twin.grey.parameters import ParameterTable

Array = NDArray[np.float64]
LEAST_ERROR = 0.02
"""Of the forces, as a share of their deviation: rows never agree better with what the bodies leave out."""
INDEPENDENT = 1_000
"""Rows that many rows count as: neighbours say the same."""
STEPS, TRIES = 30, 12


def balance_columns(table: ParameterTable, rows: Array) -> Array:
    """Return the cylinder forces per linear parameter (nine) ``(actuator, row, BASE)``.

    Args:
        table: of numbers, with a linkage.
        rows: velocity, acceleration, stroke ... ``(row, actuator, at least 3)``.
    """
    speeds, pulls, strokes = (np.ascontiguousarray(rows[:, :, k]) for k in range(3))
    return np.moveaxis(forces_by_moments(strokes, speeds, pulls, table.linkage), 0, 1)


def balance_bodies(table: ParameterTable, matrix: Array, goal: Array) -> tuple[Array, Array]:
    """Return parameters whose bodies balance the forces within plausible limits, and the other linear parameters.

    Args:
        table: of numbers, with a linkage.
        matrix: of the balance, in deviations of the forces: the nine numbers, then all else ``(row, column)``.
        goal: in the same ``(row,)``.

    Returns:
        All numbers ``(number,)``, and the coefficients of all else.
    """
    bodies, others = matrix[:, : at.BASE], matrix[:, at.BASE :]
    # All else is solved for, given the bodies: what is left is a square form in the nine numbers.
    normal = others.T @ others
    normal += 1e-9 * np.diag(np.maximum(np.diag(normal), 1e-30))
    of_bodies, of_goal = np.linalg.solve(normal, others.T @ bodies), np.linalg.solve(normal, others.T @ goal)
    left, sought = bodies - others @ of_bodies, goal - others @ of_goal
    free = np.linalg.lstsq(left, sought, rcond=None)[0]
    error = max(float(np.mean((left @ free - sought) ** 2)), LEAST_ERROR**2)
    weight = INDEPENDENT / len(goal) / error
    square, pull = weight * left.T @ left, weight * left.T @ sought
    theta, damping = np.zeros(table.potential_at - table.inertia_at), 1e-3
    least, base, slopes = _cost(table, theta, square, pull)
    for _ in range(STEPS):
        system = slopes.T @ square @ slopes + np.eye(len(theta))
        gradient = slopes.T @ (square @ base - pull) + theta
        for _ in range(TRIES):
            change = np.linalg.solve(system + damping * np.diag(np.diag(system)), gradient)
            tried = _cost(table, theta - change, square, pull)
            if tried[0] < least:
                theta, (least, base, slopes), damping = theta - change, tried, max(damping / 4.0, 1e-9)
                break
            damping *= 5.0
        else:
            break
    return _numbers(table, theta), of_goal - of_bodies @ base


def _cost(table: ParameterTable, theta: Array, square: Array, pull: Array) -> tuple[float, Array, Array]:
    """Return cost (residual balance and deviation from typical values), nine parameters and derivatives."""
    values, span = _numbers(table, theta), slice(table.inertia_at, table.potential_at)
    moments = moments_of(values, table.inertia_at, table.linkage)
    base, width = moments.values, table.width[span]
    slopes = moments.slopes * np.where(table.positive[span], values[span] * width, width)
    return float(0.5 * base @ square @ base - pull @ base + 0.5 * theta @ theta), base, slopes


def _numbers(table: ParameterTable, theta: Array) -> Array:
    """Return all grey-box parameters, with rigid-body parameters from `theta` (in prior standard deviations)."""
    values, span = table.nominal, slice(table.inertia_at, table.potential_at)
    moved = table.width[span] * theta
    grown = values[span] * np.exp(np.clip(moved, -12.0, 12.0))
    values[span] = np.where(table.positive[span], grown, values[span] + moved)
    return values
