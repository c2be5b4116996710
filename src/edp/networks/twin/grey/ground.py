"""Ground laws for a grey box with a known linkage: forces on the bucket tip below the surface.

A law is one file and one registration in `GROUNDS`. It is fitted to forces estimated from logs in soil (see
`edp.training.ground_fit`), is stored in the bundle of a twin, and acts in control loops with a material.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.networks.twin.base import Twin, TwinRunner, TwinState
from edp.networks.twin.disturbance_observer import force_slopes
from edp.networks.twin.parameters import DatasheetRow, Parameter
from edp.registry import Registry

if TYPE_CHECKING:
    from edp.networks.twin.greybox import GreyTwin

Array = NDArray[np.float64]
RENEWED_TICKS = 5
"""Interval in samples at which the effect of a force on the velocities is computed again while the bucket is in the
ground."""


class GroundContact(ABC):
    """Ground contact of one run, with memory of the excavated profile."""

    @abstractmethod
    def forces(self, strokes: Array, free: Array, slopes: Array) -> Array:
        """Return forces against the actuators (N) in the next sample.

        Args:
            strokes: strokes of all actuators before the sample, m.
            free: velocities after it without any ground, m/s.
            slopes: derivatives of the velocities by a force against each actuator ``(actuator, actuator)``, m/s per N.
        """

    @abstractmethod
    def touches(self, strokes: Array, free: Array) -> bool:
        """Return whether there would be any force; arguments as in `forces`."""


class GroundLaw(ABC):
    """Ground law with its parameters.

    Attributes:
        numbers: parameters of the law, SI units.
        deviations: standard errors of the parameters; infinite if the logs do not identify a parameter.
    """

    numbers: Array
    deviations: Array

    @classmethod
    @abstractmethod
    def from_logs(cls, twin: GreyTwin, logs: Sequence[tuple[Array, Array, Array]], machine: str) -> GroundLaw:
        """Return the law fitted to logs.

        Args:
            twin: twin with a known linkage.
            logs: strokes, velocities and estimated forces against each actuator, ``(tick, actuator)`` each, SI units.
            machine: name or file of the machine, which defines the height of the ground surface.

        Raises:
            DataError: the logs are hardly ever in the ground.
        """

    @abstractmethod
    def r_squared(self, twin: GreyTwin, logs: Sequence[tuple[Array, Array, Array]]) -> float:
        """Return the R^2 of the forces where the tip moves in the ground; NaN without such a sample."""

    @abstractmethod
    def contact(self, twin: GreyTwin) -> GroundContact:
        """Return the undisturbed ground before a run."""

    @abstractmethod
    def to_dict(self) -> dict[str, object]:
        """Return the law in JSON types."""

    @classmethod
    @abstractmethod
    def from_dict(cls, plain: Mapping[str, object]) -> GroundLaw:
        """Create the law from the result of `to_dict`.

        Raises:
            ValueError: the dictionary is damaged; KeyError and TypeError have the same cause.
        """

    @property
    @abstractmethod
    def parameters(self) -> list[Parameter]:
        """Parameters of the law."""

    def rows(self) -> list[DatasheetRow]:
        """Return the rows of the datasheet. A parameter that the logs do not determine has no interval."""
        is_finite = np.isfinite(self.deviations)
        columns = zip(self.parameters, self.numbers, np.where(is_finite, self.deviations, 0.0), is_finite, strict=True)
        return [one.row(value, deviation / one.width, excited) for one, value, deviation, excited in columns]


GROUNDS: Registry[type[GroundLaw]] = Registry("ground")


class GroundedRunner(TwinRunner):
    """Runner whose machine is in contact with a ground.

    The ground force of a sample depends on the velocity at its end, as in an implicit stage of the grey box. An
    explicit force of about 10 kN that changes sign with the velocity would oscillate from sample to sample.

    Args:
        twin: a grey box with a known linkage.
        law: law of the ground.

    Raises:
        ConfigError: the twin has no load that forces could act on, or no linkage.
    """

    def __init__(self, twin: Twin, law: GroundLaw) -> None:
        super().__init__(twin)
        self._runner = twin.runner()
        self._grey = check_grounded(twin)
        self._law, self._contact = law, law.contact(self._grey)
        columns = self._grey.wiring.columns
        self._speeds, self._strokes = (np.array([column[k] for column in columns]) for k in (0, 1))
        self.resistance = np.zeros(len(columns))
        self._slopes, self._age = np.zeros((len(columns), len(columns))), 0

    def begin(self) -> None:
        """Start with an undisturbed ground."""
        self._contact, self._age = self._law.contact(self._grey), 0

    def step(self, command: NDArray[np.float32], state: TwinState, measured: NDArray[np.float32]) -> TwinState:
        """See `TwinRunner.step`; the ground is cut."""
        self._runner.resistance = self.resistance
        after = self._runner.step(command, state, measured)
        before = np.where(np.isfinite(measured), measured, state["answer"][0]).astype(float)[self._strokes]
        free = np.asarray(after["answer"][0, self._speeds], float)
        if not self._contact.touches(before, free):
            self._age = 0
            return after
        if self._age % RENEWED_TICKS == 0:
            self._slopes = force_slopes(self._runner, self._speeds, (command, measured, state), free)
        self._age += 1
        forces = np.zeros(len(self._speeds)) if self.resistance is None else self.resistance.copy()
        forces[self._speeds] += self._contact.forces(before, free, self._slopes)
        self._runner.resistance = forces
        return self._runner.step(command, state, measured)


def check_grounded(twin: Twin) -> GreyTwin:
    """Return the twin as a grey box on which a ground can act.

    Raises:
        ConfigError: it is none, has no known linkage, or has a network on top.
    """
    from edp.networks.twin.greybox import GreyTwin

    if not isinstance(twin, GreyTwin) or twin.table.front is None or twin.runner().resistance is None:
        raise ConfigError(
            "a ground acts on a grey box with a known linkage and without a network on top; this twin is none: train "
            "one in free air with --set twin.kind=greybox --set twin.linkage=MACHINE"
        )
    return twin
