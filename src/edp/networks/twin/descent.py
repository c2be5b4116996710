"""Damped Gauss-Newton method (Levenberg and Marquardt) for coordinates in prior standard deviations.

The damping follows the ratio of actual and predicted decrease (Nielsen, IMM-REP-1999-05): it falls by up to a factor of
3 where the linear model holds, and grows by 2, 4, 8, ... in the tries of a step where it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
NOT_FINITE = 1e12
"""Loss returned instead of a loss that is not finite. It is larger than any loss of a fit."""
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e9
"""Bounds of the damping factor. They keep the linear system well-conditioned."""
MIN_CURVATURE = 1e-12
"""Minimum curvature that scales the damping, for coordinates without information from data or prior."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of a Gauss-Newton step.

    Attributes:
        matrix: Gauss-Newton matrix, shape (coordinate, coordinate). Shape (0, 0) without derivatives.
        gradient: gradient of the sum of the losses, shape (coordinate,). Shape (0,) without derivatives.
        losses: losses, of which the sum is minimised, shape (run,).
    """

    matrix: Doubles
    gradient: Doubles
    losses: Doubles

    @property
    def cost(self) -> float:
        """Sum of the losses."""
        return float(np.nan_to_num(self.losses, nan=NOT_FINITE, posinf=NOT_FINITE).sum())


Problem = Callable[[Doubles, bool], NormalEquations]
"""Function that returns the normal equations of the data at coordinates ``(coordinate,)``, or only the losses if the
flag is False."""


@dataclass(frozen=True)
class DescentLimits:
    """Limits of a descent.

    Attributes:
        steps: maximum number of steps.
        tries: maximum number of tries per step, each with more damping than the one before.
        radius: maximum change of a coordinate in one step. The linear model holds no farther.
        ftol: decrease of the cost that ends the descent, relative to the cost.
        gain: decrease of the cost that ends the descent.
        prior: weight of the prior, 1 for coordinates in prior standard deviations.
    """

    steps: int
    tries: int = 8
    radius: float = 1.5
    ftol: float = 0.0
    gain: float = 0.0
    prior: float = 1.0


@dataclass(frozen=True, eq=False)
class Descent:
    """Result of `descend`.

    Attributes:
        theta: coordinates with the least cost, shape (coordinate,).
        cost: losses and penalties there.
        matrix: Gauss-Newton matrix of the data where the last step began, shape (coordinate, coordinate).
        damping: damping for a further step.
    """

    theta: Doubles
    cost: float
    matrix: Doubles
    damping: float


def descend(
    problem: Problem, begin: Doubles, limits: DescentLimits, damping: float = 1.0, memory: Doubles | None = None
) -> Descent:
    """Minimise the losses of a problem and the penalty of its prior, whose mean is zero.

    Args:
        problem: normal equations of the data.
        begin: initial coordinates, shape (coordinate,).
        limits: limits of the descent.
        damping: initial damping, relative to the curvature.
        memory: information of earlier data, whose optimum is `begin`, shape (coordinate, coordinate).
    """
    prior = limits.prior * np.eye(len(begin))
    earlier = np.zeros_like(prior) if memory is None else memory

    def penalty(at: Doubles) -> float:
        moved = at - begin
        return 0.5 * float(at @ prior @ at + moved @ earlier @ moved)

    theta, cost, matrix = begin, np.inf, np.zeros_like(prior)
    for _ in range(limits.steps):
        equations = problem(theta, True)
        cost, matrix = equations.cost + penalty(theta), equations.matrix
        pull = equations.gradient + prior @ theta + earlier @ (theta - begin)
        system = matrix + prior + earlier
        curvature = np.diag(np.maximum(np.diag(system), MIN_CURVATURE))
        growth = 2.0
        for _ in range(limits.tries):
            change = -np.linalg.solve(system + damping * curvature, pull)
            change *= min(1.0, limits.radius / max(float(np.abs(change).max()), 1e-12))
            new = problem(theta + change, False).cost + penalty(theta + change)
            if new < cost:
                break
            damping, growth = min(growth * damping, MAX_DAMPING), 2.0 * growth
        else:
            break
        fallen, theta, cost = cost - new, theta + change, new
        ratio = -fallen / float(pull @ change + 0.5 * change @ system @ change)
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), MIN_DAMPING)
        if fallen <= max(limits.ftol * cost, limits.gain):
            break
    return Descent(theta, cost, matrix, damping)
