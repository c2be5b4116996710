"""Parameters of twins with their priors, the coordinates of a fit, and the datasheet with confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.descent import NormalEquations
from edp.settings.results import ResultFile
from edp.storage import write_bytes
from edp.wording import typed

Doubles = NDArray[np.float64]
NORMAL = 1.96
"""Half-width of a 95 % confidence interval of a normal distribution in standard deviations."""
UNEXCITED = 0.7
"""Posterior standard deviation, as a fraction of the prior's, above which the data do not identify a parameter."""
FARTHEST = 12.0
"""Maximum change of a positive parameter, in prior standard deviations of its logarithm."""
TEXT_NAME = "datasheet.txt"


@dataclass(frozen=True)
class Parameter:
    """Parameter of a model with its prior.

    Attributes:
        element: element of the model that the parameter belongs to.
        name: name of the parameter within its element.
        unit: SI unit of the value times `factor`.
        factor: SI value of one unit of the model.
        nominal: mean of the prior, from which a fit starts, in units of the model.
        width: prior standard deviation, of the logarithm if `positive`, else in units of the model; 0 for a parameter
            that is not fitted.
        positive: whether the logarithm is fitted.
        leader: number of positions before this one at which the parameter lies whose value this one always has; 0 for a
            parameter with its own value.
    """

    element: str
    name: str
    unit: str
    factor: float
    nominal: float
    width: float = 1.0
    positive: bool = True
    leader: int = 0

    @property
    def label(self) -> str:
        """Element and name."""
        return f"{self.element}.{self.name}"

    def row(self, value: float, deviation: float, excited: bool) -> DatasheetRow:
        """Return the row of the datasheet.

        Args:
            value: fitted value in units of the model.
            deviation: posterior standard deviation as a fraction of the prior's.
            excited: whether the data identify the parameter.
        """
        low, high = (float(end * self.factor) for end in interval(value, deviation * self.width, self.positive))
        return DatasheetRow(self.element, self.name, self.unit, float(value * self.factor), low, high, bool(excited))


def interval(value: float, deviation: float, positive: bool) -> tuple[float, float]:
    """Return the ends of a 95 % confidence interval; for a positive value, `deviation` refers to its logarithm."""
    reach = NORMAL * deviation
    return (value * np.exp(-reach), value * np.exp(reach)) if positive else (value - reach, value + reach)


class Parametrisation(Protocol):
    """Coordinates in which a fit varies the parameters of a model, in prior standard deviations from zero."""

    @property
    def begin(self) -> Doubles:
        """Initial coordinates ``(coordinate,)``."""
        ...

    def values(self, theta: Doubles) -> Doubles:
        """Return the parameters at coordinates, in units of the model ``(parameter,)``."""
        ...

    def transform(self, equations: NormalEquations, theta: Doubles) -> NormalEquations:
        """Transform normal equations for the parameters at `theta` into normal equations for the coordinates."""
        ...


@dataclass(frozen=True, eq=False)
class Priors:
    """Parametrisation with one coordinate per parameter.

    Attributes:
        origin: parameters at coordinate zero, in units of the model ``(parameter,)``.
        width: prior standard deviation, see `Parameter` ``(parameter,)``.
        positive: whether the logarithm is fitted ``(parameter,)``.
        leader: position of the parameter whose value each one has ``(parameter,)``.
    """

    origin: Doubles
    width: Doubles
    positive: NDArray[np.bool_]
    leader: NDArray[np.int64]

    @classmethod
    def from_parameters(cls, parameters: Sequence[Parameter]) -> Self:
        """Return the priors about the nominal values."""
        leader = [index - one.leader for index, one in enumerate(parameters)]
        origin, width = (np.array([getattr(one, name) for one in parameters]) for name in ("nominal", "width"))
        return cls(origin, width, np.array([one.positive for one in parameters]), np.array(leader, dtype=np.int64))

    @property
    def begin(self) -> Doubles:
        """Initial coordinates: zeros ``(parameter,)``."""
        return np.zeros(len(self.origin))

    def values(self, theta: NDArray[Any]) -> NDArray[Any]:
        """Return the parameters at coordinates ``(..., parameter)``; complex ones carry derivatives."""
        bounded = np.where(np.abs(theta.real) < FARTHEST, theta, FARTHEST * np.sign(theta.real))
        grown = self.origin * np.exp(np.where(self.positive, self.width * bounded, 0.0))
        values = np.where(self.positive, grown, self.origin + self.width * theta)
        return np.asarray(values[..., self.leader])

    def coordinates(self, values: Doubles) -> Doubles:
        """Return the coordinates of parameters ``(parameter,)``."""
        ratio = np.where(self.positive, values / np.where(self.positive, self.origin, 1.0), 1.0)
        return np.asarray(np.where(self.positive, np.log(ratio), values - self.origin) / self.width)

    def slopes(self, values: Doubles) -> Doubles:
        """Return the derivative of each parameter by its coordinate, or by the leader's ``(parameter,)``."""
        return np.asarray(np.where(self.positive, values * self.width, self.width)[self.leader])

    def transform(self, equations: NormalEquations, theta: Doubles) -> NormalEquations:
        """Return normal equations by the coordinates. Derivatives by followers move to their leaders."""
        slope = self.slopes(self.values(theta))
        matrix, gradient = equations.matrix * slope * slope[:, None], equations.gradient * slope
        for index in np.flatnonzero(self.leader != np.arange(len(self.leader))):
            leader = self.leader[index]
            matrix[leader] += matrix[index]
            matrix[:, leader] += matrix[:, index]
            gradient[leader] += gradient[index]
            matrix[index], matrix[:, index], gradient[index] = 0.0, 0.0, 0.0
        return NormalEquations(matrix, gradient, equations.losses)


def posterior_deviations(information: Doubles) -> Doubles:
    """Return the standard deviations that remain of coordinates with a prior standard deviation of 1.

    Args:
        information: inverse covariance by the data alone ``(coordinate, coordinate)``.
    """
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(information))))))


@dataclass(frozen=True)
class DatasheetRow:
    """Parameter of a datasheet.

    Attributes:
        element: element of the model.
        name: name of the parameter within its element.
        unit: SI unit of the value.
        value: fitted value.
        low: lower end of an approximate 95 % interval.
        high: upper end.
        excited: whether the data identify the parameter; otherwise the value is the prior mean.
    """

    element: str
    name: str
    unit: str
    value: float
    low: float
    high: float
    excited: bool


def datasheet_rows(parameters: Sequence[Parameter], values: Doubles, deviations: Doubles) -> list[DatasheetRow]:
    """Return one row per fitted parameter.

    Args:
        parameters: parameters of a model.
        values: fitted values in units of the model ``(parameter,)``.
        deviations: posterior standard deviations as fractions of the prior's ``(parameter,)``.
    """
    rows = zip(parameters, values, deviations, strict=True)
    return [one.row(value, share, share < UNEXCITED) for one, value, share in rows if one.width > 0.0]


@dataclass(frozen=True, kw_only=True)
class Datasheet(ResultFile):
    """Content of ``datasheet.json``: fitted parameters of a machine.

    Attributes:
        basis: source of the intervals.
        numbers: rows in the order of the parameters.
    """

    NAME = "datasheet.json"
    SCHEMA = 1
    WHAT = "datasheet"
    ADVICE = "train the twin again"

    basis: str
    numbers: tuple[DatasheetRow, ...]

    def write(self, folder: str | Path) -> None:
        """Write the file, and its text next to it, into a folder."""
        super().write(folder)
        write_bytes(Path(folder) / TEXT_NAME, self.to_text().encode())

    def to_text(self) -> str:
        """Return a table for readers, headed by the basis of the intervals."""
        labels = [f"{row.element}.{row.name}" for row in self.numbers]
        lines = [
            self.basis + ".",
            "A number in brackets is one that the data do not excite: what was plausible before stands.",
            "",
        ]
        for label, row in zip(labels, self.numbers, strict=True):
            value = typed(row.value) if row.excited else f"({typed(row.value)})"
            text = f"{label.ljust(max(map(len, labels)))}  {value:>12}"
            lines.append(f"{text}  {row.low:>10.3g} to {row.high:<10.3g}  {row.unit}")
        return "\n".join(lines) + "\n"
