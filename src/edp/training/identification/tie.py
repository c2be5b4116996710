"""Parametrisation of a grey box by a machine: the fit varies the parameters of a machine file.

The first machine is the one whose grey box is nearest to a fitted one, in the metric of what the data told of that:

    min (x(theta) - x)' I (x(theta) - x) + theta' theta

x are the coordinates of the fitted grey box, I their information, theta the numbers of the machine in plausible
deviations from a guess. Free runs then refine theta itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey.parameters import ParameterTable
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import BOUNDS
from edp.training.identification.machine_numbers import MACHINE_NUMBERS, guesses, set_values
from edp.training.identification.mapping import GreyParts, grey_numbers

Doubles = NDArray[np.float64]
STEP = 1e-4
"""Of the differences that give the slopes of the map, in plausible deviations."""
FARTHEST = 12.0
"""Deviations beyond which no number is moved."""
MOST_ITERATIONS, ENOUGH = 60, 1e-12
SETTLED = 0.01
"""Squared plausible deviations that a step must win: what is left moves no coordinate by much of a deviation, and free
runs refine it."""
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9


@dataclass(frozen=True, eq=False)
class MachineTie:
    """Coordinates of a fit: machine parameters, then load parameters (polynomials, or bodies of a known linkage).

    Attributes:
        base: the machine that is guessed.
        parts: which element of the grey box is which part of it.
        load: numbers of the load from which a fit begins, in units of the grey box.
        free: coordinates that move; the others stay at the guess ``(number of the machine,)``.
        begin: where a fit begins ``(coordinate,)``.
    """

    base: Machine
    parts: GreyParts
    load: Doubles
    free: NDArray[np.bool_]
    begin: Doubles

    @staticmethod
    def of(base: Machine, parts: GreyParts, load: Doubles) -> MachineTie:
        """From the guess itself."""
        count = len(MACHINE_NUMBERS)
        return MachineTie(base, parts, load, np.ones(count, np.bool_), np.zeros(count + len(load)))

    def load_at(self, theta: Doubles) -> Doubles:
        """Numbers of the load at all coordinates, in units of the grey box."""
        moved, positive = self._load_width * theta[len(MACHINE_NUMBERS) :], self._load_positive
        grown = self.load * np.exp(np.clip(moved, -FARTHEST, FARTHEST))
        return np.where(positive, grown, self.load + moved)

    def load_slope(self, load: Doubles) -> Doubles:
        """Return the derivatives of the load parameters by their coordinates (prior standard deviations)."""
        return np.where(self._load_positive, load * self._load_width, self._load_width)

    @property
    def _load_width(self) -> Doubles:
        return self.parts.table.width[self.parts.load]

    @property
    def _load_positive(self) -> NDArray[np.bool_]:
        return self.parts.table.positive[self.parts.load]

    @cached_property
    def _base_values(self) -> tuple[Doubles, Doubles]:
        """Return the guesses and the stated values of the base machine, cached, since differences need them often."""
        return guesses(self.base), np.array([number.of(self.base) for number in MACHINE_NUMBERS])

    def machine(self, theta: Doubles) -> Machine:
        """Return the machine for these coordinates; fixed parameters equal the guess, zeros included."""
        return set_values(self.base, self._values(theta))

    def _values(self, theta: Doubles) -> Doubles:
        own = np.clip(theta[: len(MACHINE_NUMBERS)], -FARTHEST, FARTHEST)
        guess, stated = self._base_values
        values = np.where(self.free, np.minimum(guess * np.exp(WIDTHS * own), MOST), stated)
        # Cushions that meet in the middle are refused by a machine file.
        values[CUSHIONS] = np.minimum(values[CUSHIONS], LONGEST_CUSHION * values[STROKES])
        return values

    def numbers(self, theta: Doubles) -> Doubles:
        """Numbers of the grey box, in its units ``(number,)``."""
        numbers = grey_numbers(self.machine(theta), self.parts, self.load_at(theta))
        # A logarithm has no zero: a regeneration that is not there is a very small one.
        return np.where(self.parts.table.positive, np.maximum(numbers, TINY * self.parts.table.nominal), numbers)

    def slopes(self, theta: Doubles) -> Doubles:
        """Return the derivatives of the parameters by the coordinates ``(number, coordinate)``."""
        count = len(MACHINE_NUMBERS)
        result = np.zeros((len(self.parts.table.numbers), len(theta)))
        for k in np.flatnonzero(self.free):
            step = np.zeros(len(theta))
            step[k] = STEP
            result[:, k] = (self.numbers(theta + step) - self.numbers(theta - step)) / (2.0 * STEP)
        result[self.parts.load, count:] = np.diag(self.load_slope(self.load_at(theta)))
        return result


TINY = 1e-6
"""Of the plausible value: what is as good as zero."""
MOST: Doubles = np.array([BOUNDS[number.path].high if number.path in BOUNDS else np.inf for number in MACHINE_NUMBERS])
"""Largest values that a machine file may have."""
CUSHIONS, STROKES = (
    np.array([k for k, number in enumerate(MACHINE_NUMBERS) if number.path == f"cylinders.{key}"])
    for key in ("cushion_length", "stroke")
)
"""Places of both among the numbers, a cylinder each."""
LONGEST_CUSHION = 0.499
"""Of the stroke: half of it is the limit of a machine file, less what its digits round away."""
WIDTHS: Doubles = np.array([number.width for number in MACHINE_NUMBERS])


def coordinates(table: ParameterTable, numbers: Doubles, origin: Doubles) -> Doubles:
    """Return coordinates of parameters: prior standard deviations from `origin`, logarithmic for positive ones."""
    safe = np.where(table.positive, numbers / np.where(table.positive, origin, 1.0), 1.0)
    return np.asarray(np.where(table.positive, np.log(safe), numbers - origin) / table.width)


def nearest(tie: MachineTie, numbers: Doubles, information: Doubles, prior: float = 1.0) -> Doubles:
    """Return the coordinates of the machine whose grey box is nearest to these parameters (damped Gauss-Newton).

    Args:
        tie: the coordinates.
        numbers: of the fitted grey box, in its units.
        information: of its coordinates at these numbers, in plausible deviations ``(number, number)``.
        prior: weight of the guess.
    """
    table, theta, damping = tie.parts.table, tie.begin.copy(), 1.0
    slope = np.where(table.positive, numbers * table.width, table.width)

    def residual(at: Doubles) -> Doubles:
        return coordinates(table, tie.numbers(at), numbers)

    def cost(at: Doubles) -> float:
        apart = residual(at)
        return float(apart @ information @ apart + prior * at @ at)

    least = cost(theta)
    for _ in range(MOST_ITERATIONS):
        # Slopes of the coordinates at where the machine is now, not at where the fitted numbers are.
        now = np.where(table.positive, tie.numbers(theta) * table.width, slope)
        jacobian = tie.slopes(theta) / now[:, None]
        pull = jacobian.T @ information @ residual(theta) + prior * theta
        system = jacobian.T @ information @ jacobian + prior * np.eye(len(theta))
        before = least
        while damping < MOST_DAMPING:
            scale = np.diag(damping * np.maximum(np.diag(system), ENOUGH))
            tried = theta - np.linalg.solve(system + scale, pull)
            if (new := cost(tried)) < least:
                theta, least, damping = tried, new, max(damping / 5.0, LEAST_DAMPING)
                break
            damping *= 4.0
        if before - least <= max(ENOUGH * max(least, ENOUGH), SETTLED * prior):
            break
    return theta


def deviations(information: Doubles) -> Doubles:
    """Deviations that the data leave of coordinates whose plausible ones are 1, if errors were new at each tick."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(information))))))


def fix_coordinates(theta: Doubles, information: Doubles, back: NDArray[np.bool_]) -> Doubles:
    """Return the optimum of the quadratic for the other coordinates after some are reset to the guess.

    Args:
        theta: optimum of all.
        information: there.
        back: coordinates that are set back to zero.
    """
    system, rest = information + np.eye(len(theta)), ~back
    moved = theta.copy()
    moved[back] = 0.0
    moved[rest] += np.linalg.solve(system[np.ix_(rest, rest)], system[np.ix_(rest, back)] @ theta[back])
    return moved
