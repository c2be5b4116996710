"""Parametrisation of a grey box by a machine: the fit varies the parameters of a machine file.

The first machine is the one whose grey box is nearest to a fitted one, in the metric of what the data told of that:

    min (x(theta) - x)' I (x(theta) - x) + theta' theta

x are the coordinates of the fitted grey box, I their information, theta the parameters of the machine in prior standard
deviations from a guess. Free runs then refine theta itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.descent import DescentLimits, NormalEquations, descend
from edp.networks.twin.parameters import Priors
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import BOUNDS
from edp.training.identification.machine_numbers import MACHINE_NUMBERS, guesses, set_values
from edp.training.identification.mapping import GreyParts, grey_numbers

Doubles = NDArray[np.float64]
STEP = 1e-4
"""Of the differences that give the slopes of the map, in prior standard deviations."""
SETTLED = 0.01
"""Squared prior standard deviations that a step must win: what is left moves no coordinate by much of a deviation, and
free runs refine it."""
TINY = 1e-6
"""Of the plausible value: what is as good as zero."""
COUNT = len(MACHINE_NUMBERS)
MOST: Doubles = np.array([BOUNDS[number.path].high if number.path in BOUNDS else np.inf for number in MACHINE_NUMBERS])
"""Largest values that a machine file may have."""
CUSHIONS, STROKES = (
    np.array([k for k, number in enumerate(MACHINE_NUMBERS) if number.path == f"cylinders.{key}"])
    for key in ("cushion_length", "stroke")
)
"""Places of both among the numbers, a cylinder each."""
STROKE_RANGE = (0.97, 1.03)
"""Of the guess's: logs beyond it are refused, too (`edp.training.identification.elements.BEYOND`)."""
LONGEST_CUSHION = 0.499
"""Of the stroke: half of it is the limit of a machine file, less what its digits round away."""


@dataclass(frozen=True, eq=False)
class MachineParametrisation:
    """Coordinates of a fit: machine parameters, then load parameters (polynomials, or bodies of a known linkage).

    Attributes:
        base: the machine that is guessed.
        parts: assignment of grey-box elements to parts of the machine.
        load: load parameters from which a fit begins, in units of the grey box.
        free: coordinates that move; the others stay at the guess ``(number of the machine,)``.
        begin: initial coordinates of a fit ``(coordinate,)``.
    """

    base: Machine
    parts: GreyParts
    load: Doubles
    free: NDArray[np.bool_]
    begin: Doubles

    @staticmethod
    def from_guess(base: Machine, parts: GreyParts, load: Doubles) -> MachineParametrisation:
        """Return coordinates that begin at the guess itself."""
        return MachineParametrisation(base, parts, load, np.ones(COUNT, np.bool_), np.zeros(COUNT + len(load)))

    @cached_property
    def machine_priors(self) -> Priors:
        """Priors of the machine parameters about the guess."""
        width = np.array([number.width for number in MACHINE_NUMBERS])
        return Priors(guesses(self.base), width, np.ones(COUNT, np.bool_), np.arange(COUNT))

    @cached_property
    def load_priors(self) -> Priors:
        """Priors of the load parameters about the initial ones."""
        every, span = self.parts.table.priors, self.parts.load
        return Priors(self.load, every.width[span], every.positive[span], np.arange(len(self.load)))

    def load_at(self, theta: Doubles) -> Doubles:
        """Return the load parameters at all coordinates, in units of the grey box."""
        return self.load_priors.values(theta[COUNT:])

    def machine(self, theta: Doubles) -> Machine:
        """Return the machine for these coordinates; fixed parameters equal the guess, zeros included."""
        stated = np.array([number.read(self.base) for number in MACHINE_NUMBERS])
        values = np.where(self.free, np.minimum(self.machine_priors.values(theta[:COUNT]), MOST), stated)
        # A machine file refuses strokes that its pins cannot take, and cushions that meet in the middle.
        values[STROKES] = np.clip(values[STROKES], *(share * stated[STROKES] for share in STROKE_RANGE))
        values[CUSHIONS] = np.minimum(values[CUSHIONS], LONGEST_CUSHION * values[STROKES])
        return set_values(self.base, values)

    def values(self, theta: Doubles) -> Doubles:
        """Return the grey-box parameters at coordinates, in units of the grey box ``(parameter,)``."""
        numbers = grey_numbers(self.machine(theta), self.parts, self.load_at(theta))
        # A logarithm has no zero: a regeneration that is not there is a very small one.
        return np.where(self.parts.table.positive, np.maximum(numbers, TINY * self.parts.table.nominal), numbers)

    def slopes(self, theta: Doubles) -> Doubles:
        """Return the derivatives of the grey-box parameters by the coordinates ``(parameter, coordinate)``."""
        result = np.zeros((len(self.parts.table.numbers), len(theta)))
        for k in np.flatnonzero(self.free):
            step = np.zeros(len(theta))
            step[k] = STEP
            result[:, k] = (self.values(theta + step) - self.values(theta - step)) / (2.0 * STEP)
        result[self.parts.load, COUNT:] = np.diag(self.load_priors.slopes(self.load_at(theta)))
        return result

    def transform(self, equations: NormalEquations, theta: Doubles) -> NormalEquations:
        """Transform normal equations for the grey-box parameters at `theta` to the coordinates of the fit."""
        slopes = self.slopes(theta)
        return NormalEquations(slopes.T @ equations.matrix @ slopes, slopes.T @ equations.gradient, equations.losses)


def nearest_machine(
    parametrisation: MachineParametrisation, numbers: Doubles, information: Doubles, prior: float = 1.0
) -> Doubles:
    """Return the coordinates of the machine whose grey box is nearest to these parameters.

    Args:
        parametrisation: the coordinates.
        numbers: parameters of the fitted grey box, in its units ``(parameter,)``.
        information: information on them, in prior standard deviations ``(parameter, parameter)``.
        prior: weight of the guess.
    """
    target = replace(parametrisation.parts.table.priors, origin=numbers)

    def problem(theta: Doubles, full: bool) -> NormalEquations:
        values = parametrisation.values(theta)
        apart = target.coordinates(values)
        pull = information @ apart
        losses = np.array([0.5 * apart @ pull])
        if not full:
            return NormalEquations(np.zeros((0, 0)), np.zeros(0), losses)
        # Slopes of the coordinates at where the machine is now, not at where the fitted numbers are.
        jacobian = parametrisation.slopes(theta) / target.slopes(values)[:, None]
        return NormalEquations(jacobian.T @ information @ jacobian, jacobian.T @ pull, losses)

    limits = DescentLimits(steps=60, tries=15, radius=np.inf, ftol=1e-12, gain=0.5 * SETTLED * prior, prior=prior)
    return descend(problem, parametrisation.begin, limits).theta


def reset_to_guess(theta: Doubles, information: Doubles, back: NDArray[np.bool_]) -> Doubles:
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
