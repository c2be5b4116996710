"""Initial load of a grey-box fit: the force balance, solved by least squares on the measurements.

    A_A p_A = A_B p_B + M v' + grad U(s) + F_C sign(v) + F_v v

For a motor these are torques, and both areas are its displacement. The balance is linear in all unknown parameters, so
it needs no initial values. Pose-dependent inertia is fitted later on free-run simulations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.networks.twin.descent import DescentLimits, NormalEquations, descend
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.bodies import forces_by_moments, moments_of
from edp.networks.twin.grey.parameters import ParameterTable

Array = NDArray[np.float64]
REACH = 2
"""Number of samples before and after a sample over which velocities are differentiated. The interval reduces noise and
keeps oscillations of a few Hz."""
FEW = 40_000
"""Maximum number of rows in the initial fit of the load."""
MIN_INERTIA = 0.02
"""Minimum inertia as a fraction of the prior mean."""
SHARE_RANGE = (0.2, 1.0)
"""Accepted ratio of rod-side area to head-side area. Estimates outside this range are not used."""
MIN_ERROR = 0.02
"""Minimum error of the forces, as a fraction of their standard deviation: the rigid-body model omits some effects."""
INDEPENDENT = 1_000
"""Number of independent rows that all rows count as, because neighbouring rows are correlated."""
LIMITS = DescentLimits(steps=30, tries=12, radius=np.inf, ftol=1e-9)
"""Limits of the initial fit. The force balance is nearly linear in the body parameters, so the step size is unlimited.
"""


def load_start(
    table: ParameterTable,
    train: Sequence[Series],
    columns: Sequence[tuple[int, int, int, int]],
    z_of: tuple[Array, Array],
    rate_hz: float,
    declared: Sequence[bool],
) -> Array:
    """Return nominal parameters; the load parameters come from the force balance if everything is measured.

    Args:
        table: parameters with their priors.
        train: training segments.
        columns: output columns of velocity, stroke, head and rod pressure of each actuator; -1 if not measured.
        z_of: middle and scale of the strokes.
        rate_hz: samples per second.
        declared: whether both areas of each actuator are known, or one area follows from the other.
    """
    values = table.nominal
    by_stroke = np.asarray(table.exponents.any(axis=0)) | (len(table.linkage) > 0)
    needed = np.ones((len(columns), 4), np.bool_)
    needed[:, 1] = by_stroke
    if (needed & (np.array(columns) < 0)).any():
        return values
    rows = _rows(train, columns, by_stroke, rate_hz)
    speed, head, rod = (rows[:, :, k] for k in (0, 3, 4))
    own = _load_columns(table, rows, z_of)
    n, load = len(columns), own.shape[2]
    matrix, goal = np.zeros((n, len(rows), load + 3 * n)), np.zeros((n, len(rows)))
    matrix[:, :, :load] = own
    for i in range(n):
        a = table.actuator_at[i]
        own_at = load + 3 * i
        matrix[i, :, own_at] = np.tanh(speed[:, i] / values[a + at.STRIBECK])
        matrix[i, :, own_at + 1] = speed[:, i]
        goal[i] = values[a + at.HEAD_AREA] * head[:, i]
        if declared[i]:
            goal[i] -= values[a + at.ROD_AREA] * rod[:, i]
        else:
            matrix[i, :, own_at + 2] = rod[:, i]
        size = max(float(goal[i].std()), 1e-9)
        matrix[i] /= size
        goal[i] /= size
    flat = matrix.reshape(-1, matrix.shape[2]), goal.reshape(-1)
    if table.front is not None:
        values, others = _balance_bodies(table, *flat)
        return _insert_friction(table, others, declared, values)
    return _insert_solution(table, _ridge(*flat), declared, values)


def _balance_bodies(table: ParameterTable, matrix: Array, goal: Array) -> tuple[Array, Array]:
    """Return all parameters, with the bodies that balance the forces, and the coefficients of the other columns.

    Args:
        table: parameters, with a linkage.
        matrix: balance in deviations of the forces: base parameters of the bodies, then all else ``(row, column)``.
        goal: forces in the same unit ``(row,)``.
    """
    bodies, others = matrix[:, : at.BASE], matrix[:, at.BASE :]
    # All other parameters are eliminated for given bodies, which leaves a quadratic form in the nine body parameters.
    normal = others.T @ others
    normal += 1e-9 * np.diag(np.maximum(np.diag(normal), 1e-30))
    of_bodies, of_goal = np.linalg.solve(normal, others.T @ bodies), np.linalg.solve(normal, others.T @ goal)
    left, sought = bodies - others @ of_bodies, goal - others @ of_goal
    free = np.linalg.lstsq(left, sought, rcond=None)[0]
    error = max(float(np.mean((left @ free - sought) ** 2)), MIN_ERROR**2)
    weight = INDEPENDENT / len(goal) / error
    square, span = weight * left.T @ left, slice(table.inertia_at, table.potential_at)

    def problem(theta: Array, full: bool) -> NormalEquations:
        values = _with_bodies(table, theta)
        moments = moments_of(values, table.inertia_at, table.linkage)
        apart, slopes = moments.values - free, moments.slopes * table.priors.slopes(values)[span]
        return NormalEquations(
            slopes.T @ square @ slopes, slopes.T @ square @ apart, np.array([0.5 * apart @ square @ apart])
        )

    descent = descend(problem, np.zeros(span.stop - span.start), LIMITS, damping=1e-3)
    values = _with_bodies(table, descent.theta)
    return values, of_goal - of_bodies @ moments_of(values, table.inertia_at, table.linkage).values


def _with_bodies(table: ParameterTable, theta: Array) -> Array:
    """Return all grey-box parameters, with rigid-body parameters from `theta` (in prior standard deviations)."""
    every = np.zeros(len(table.numbers))
    every[table.inertia_at : table.potential_at] = theta
    return table.priors.values(every)


def _load_columns(table: ParameterTable, rows: Array, z_of: tuple[Array, Array]) -> Array:
    """Return the actuator forces per linear load parameter ``(actuator, row, column)``."""
    if table.front is not None:
        speeds, pulls, strokes = (np.ascontiguousarray(rows[:, :, k]) for k in range(3))
        return np.moveaxis(forces_by_moments(strokes, speeds, pulls, table.linkage), 0, 1)
    n, exponents, pull = rows.shape[1], table.exponents, rows[:, :, 1]
    z, inertia = (rows[:, :, 2] - z_of[0]) * z_of[1], _entries(n)
    matrix = np.zeros((n, len(rows), len(inertia) + len(exponents) - 1))
    for i in range(n):
        for k, (p, r) in enumerate(inertia):
            if i in (p, r):
                matrix[i, :, k] = pull[:, r if i == p else p]
        for b in range(1, len(exponents)):
            e = exponents[b]
            if e[i]:
                lower = e - (np.arange(n) == i)
                matrix[i, :, len(inertia) + b - 1] = e[i] * z_of[1][i] * np.prod(z**lower, axis=1)
    return matrix


def _entries(n: int) -> list[tuple[int, int]]:
    """Return the index pairs of a symmetric matrix, row by row."""
    return [(a, c) for a in range(n) for c in range(a + 1)]


def _insert_solution(table: ParameterTable, solution: Array, declared: Sequence[bool], values: Array) -> Array:
    """Insert the solution into the parameters where it is plausible."""
    n = len(table.actuator_at)
    inertia = _entries(n)
    mass = np.zeros((n, n))
    for k, (p, r) in enumerate(inertia):
        mass[p, r] = mass[r, p] = solution[k]
    # Scale by the prior inertia of each actuator: the inertia of a motor may be a millionth of a cylinder's.
    start = np.diag([values[table.inertia_at + k * table.inertia_terms] for k, (p, r) in enumerate(inertia) if p == r])
    moments, vectors = np.linalg.eigh(np.linalg.solve(start, np.linalg.solve(start, mass).T))
    # At least a fiftieth of it along each direction (200 kg): noise must not make an inertia negative.
    low = start @ np.linalg.cholesky((vectors * np.maximum(moments, MIN_INERTIA)) @ vectors.T)
    for k, (p, r) in enumerate(inertia):
        values[table.inertia_at + k * table.inertia_terms] = low[p, r]
    potential = len(table.exponents) - 1
    values[table.potential_at : table.potential_at + potential] = solution[len(inertia) : len(inertia) + potential]
    return _insert_friction(table, solution[len(inertia) + potential :], declared, values)


def _insert_friction(table: ParameterTable, solution: Array, declared: Sequence[bool], values: Array) -> Array:
    """Insert friction and rod areas into the parameters where they are plausible."""
    for i in range(len(table.actuator_at)):
        a, own = table.actuator_at[i], 3 * i
        for index, value in ((at.COULOMB, solution[own]), (at.VISCOUS, solution[own + 1])):
            values[a + index] = np.clip(value, 0.2 * values[a + index], 5.0 * values[a + index])
        if not declared[i]:
            share = np.clip(solution[own + 2] / values[a + at.HEAD_AREA], *SHARE_RANGE)
            values[a + at.ROD_AREA] = share * values[a + at.HEAD_AREA]
    return values


def _rows(
    train: Sequence[Series], columns: Sequence[tuple[int, int, int, int]], by_stroke: NDArray[np.bool_], rate_hz: float
) -> Array:
    """Return the velocity, acceleration, stroke, head and rod pressure ``(row, actuator, 5)``, far from the stops.

    The stroke is zero where no load depends on it (`by_stroke`), as a motor has no stops.
    """
    parts = []
    every = max(1, sum(series.samples for series in train) // FEW)
    for series in train:
        values = series.targets.astype(np.float64)
        middle = values[REACH:-REACH]
        part = np.empty((len(middle), len(columns), 5))
        for i, (speed, stroke, head, rod) in enumerate(columns):
            part[:, i, 0] = middle[:, speed]
            part[:, i, 1] = (values[2 * REACH :, speed] - values[: -2 * REACH, speed]) * rate_hz / (2 * REACH)
            part[:, i, 2] = middle[:, stroke] if by_stroke[i] else 0.0
            part[:, i, 3], part[:, i, 4] = middle[:, head] / 1e6, middle[:, rod] / 1e6
        parts.append(part[::every])
    rows = np.concatenate(parts)
    strokes = rows[:, by_stroke, 2]
    low, high = strokes.min(axis=0), strokes.max(axis=0)
    inside = ((strokes > low + 0.02 * (high - low)) & (strokes < high - 0.02 * (high - low))).all(axis=1)
    return rows[inside] if inside.sum() > 0.1 * len(rows) else rows


def _ridge(matrix: Array, goal: Array) -> Array:
    """Return the least-squares solution for columns of one size."""
    size = np.sqrt(np.square(matrix).mean(axis=0))
    scaled = matrix / np.maximum(size, 1e-12)
    normal = scaled.T @ scaled + 1e-6 * len(goal) * np.eye(matrix.shape[1])
    return np.asarray(np.linalg.solve(normal, scaled.T @ goal) / np.maximum(size, 1e-12))
