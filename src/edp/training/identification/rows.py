"""Results of an identification per parameter: value, interval, and whether the logs identify it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.parameters import FARTHEST, NORMAL, UNEXCITED, interval
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import CYLINDERS
from edp.training.identification.bodies import NAMES, Poses, base_parameters, grey_load, read_bodies, solve_base
from edp.training.identification.machine_numbers import MACHINE_NUMBERS
from edp.training.identification.parametrisation import STEP, MachineParametrisation
from edp.wording import typed

Doubles = NDArray[np.float64]
TOLD = 0.2
"""Share of a number that its interval may reach to either side for it to be told, and not roughly told."""
BODIES = "inertia and gravity"
"""Group of the nine numbers of the bodies."""


@dataclass(frozen=True)
class IdentifiedNumber:
    """One number.

    Attributes:
        label: section, key and cylinder.
        group: name of the group of parameters that are evaluated together.
        unit: unit of the values.
        base: value of the guessed machine.
        value: identified; that of the guess where the logs do not tell it.
        low: lower end of an approximate 95 % interval; `high` the upper one.
        high: upper end.
        excited: whether the logs say something of it; else it is that of the guess.
        is_told: whether they tell it: its interval reaches no farther than `TOLD` of it.
    """

    label: str
    group: str
    unit: str
    base: float
    value: float
    low: float
    high: float
    excited: bool
    is_told: bool

    def interval(self, unknown: str) -> str:
        """Return the interval as text: its ends, exact or approximate, or `unknown`."""
        if not self.excited:
            return unknown
        return f"{'' if self.is_told else 'roughly '}{typed(self.low, 3)} to {typed(self.high, 3)}"

    def to_dict(self) -> dict[str, object]:
        """Return the row in JSON types."""
        return dict(vars(self))


def number_rows(base: Machine, machine: Machine, left: Doubles, excited: NDArray[np.bool_]) -> list[IdentifiedNumber]:
    """Return one row per entry of `MACHINE_NUMBERS`.

    Args:
        base: the guess.
        machine: the identified one.
        left: deviations that the data leave, as shares of the plausible ones ``(number,)``.
        excited: mask of the parameters that the logs identify.
    """
    rows = []
    for number, share, is_known in zip(MACHINE_NUMBERS, left, excited, strict=True):
        # Where parts of the logs contradict one another, an interval may have no end.
        value, deviation = number.read(machine), min(share, FARTHEST) * number.width
        low, high = interval(value, deviation if is_known else 0.0, positive=True)
        is_told = bool(is_known and np.exp(NORMAL * deviation) <= 1.0 + TOLD)
        measured = number.label, number.group, number.unit, number.read(base), value, float(low), float(high)
        rows.append(IdentifiedNumber(*measured, bool(is_known), is_told))
    return rows


def body_rows(
    parametrisation: MachineParametrisation,
    load: Doubles,
    covariance: Doubles,
    z_of: tuple[Doubles, Doubles],
    poses: Poses,
) -> tuple[Doubles, list[IdentifiedNumber]]:
    """Return the nine base parameters of the bodies with one row each.

    Args:
        parametrisation: the guess, and which element is which.
        load: load parameters, in units of the grey box.
        covariance: covariance of their coordinates.
        z_of: middle and scale of the strokes.
        poses: poses of the logs.
    """
    base, table = parametrisation.base, parametrisation.parts.table

    def solved(values: Doubles) -> Doubles:
        if table.front is not None:
            return base_parameters(read_bodies(values, base))
        return solve_base(*grey_load(table, values, z_of, poses), poses, base)

    nine, guess = solved(load), base_parameters(base.bodies)
    slopes = np.empty((len(nine), len(load)))
    for k, size in enumerate(parametrisation.load_priors.slopes(load)):
        moved = np.zeros(len(load))
        moved[k] = STEP * size
        slopes[:, k] = (solved(load + moved) - solved(load - moved)) / (2.0 * STEP)
    left = np.sqrt(np.einsum("ik,kl,il->i", slopes, covariance, slopes))
    before = np.sqrt(np.square(slopes).sum(axis=1))
    rows = []
    for i, name in enumerate(NAMES):
        reach, unit = NORMAL * float(left[i]), "kg m" if i < 6 else "kg m^2"
        ends = interval(float(nine[i]), float(left[i]), positive=False)
        excited, is_told = bool(left[i] < UNEXCITED * before[i]), reach <= TOLD * abs(float(nine[i]))
        label = f"bodies.{name}"
        rows.append(
            IdentifiedNumber(label, BODIES, unit, float(guess[i]), float(nine[i]), *ends, excited, excited and is_told)
        )
    return nine, rows


def line_comments(rows: Sequence[IdentifiedNumber]) -> dict[tuple[str, str], str]:
    """Return the comment after each line of the machine file."""
    comments: dict[tuple[str, str], list[str]] = {}
    for number, row in zip(MACHINE_NUMBERS, rows, strict=False):
        name = "" if number.cylinder is None else f"{CYLINDERS[number.cylinder]} "
        text = row.interval("kept, not told by the logs")
        comments.setdefault((number.section, number.key), []).append(f"{name}{text}")
    static = ("friction", "static_fraction")
    comments[static] = [f"less Coulomb: {text}" for text in comments[static]]
    return {key: "; ".join(texts) for key, texts in comments.items()}
