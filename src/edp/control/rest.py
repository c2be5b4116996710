"""Measured rows of a machine in steady state, with which plants without a simulator begin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.plant import PILOTS, STROKES, VELOCITIES
from edp.errors import ConfigError, closest
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv


class RestingMachine:
    """Rows of a simulated machine with its levers at neutral, without noise.

    A model that was learned says nothing of the pressures at a pose at rest, and its prefix must be measured.

    Args:
        machine: name or file of the machine.
        names: channels of a row.
        rate_hz: ticks per second.
        ticks: rows before the last one.

    Attributes:
        machine: its numbers.
        commands: nominal pilot pressures (Pa) of levers, see `edp.sim.environment.NominalMachine.commands`.

    Raises:
        ConfigError: no such machine or channel.
    """

    def __init__(self, machine: str, names: Sequence[str], rate_hz: float, ticks: int) -> None:
        spec = EnvironmentSpec(
            machine=machine,
            duration_s=(ticks + 2) / rate_hz,
            rate_hz=rate_hz,
            sensor_noise=False,
            observed=tuple(names),
        )
        self._env, self._ticks = ExcavatorEnv(spec), ticks
        self.machine, self.commands = self._env.machine, self._env.commands

    def rows(self, shares: Any) -> NDArray[np.float32]:
        """Return the steady rows at the given strokes (fractions of full stroke), shape (ticks + 1, channel)."""
        options = {"strokes": tuple(map(float, shares))}
        rows = [self._env.reset(seed=0, options=options)[0]]
        rows += [self._env.step(np.zeros(AXES))[0] for _ in range(self._ticks)]
        return np.array(rows, np.float32)


def check_plant_channels(what: str, commands: Sequence[str], answers: Sequence[str], change: str) -> None:
    """Raise an error unless the plant is an excavator of Table A.1.

    Args:
        what: the plant, for the message.
        commands: names of what commands it.
        answers: names of what it answers.
        change: what to do, for the message.

    Raises:
        ConfigError: names the first channel that lacks, or that is none of a lever's pilot pressures.
    """
    lacking = [name for name in (*STROKES, *VELOCITIES) if name not in answers]
    strange = [name for name in commands if name not in PILOTS]
    if lacking or strange:
        fault = f"has no {lacking[0]}" if lacking else f"is commanded by '{strange[0]}'{closest(strange[0], PILOTS)}"
        raise ConfigError(
            f"{what} {fault}; a plant in closed loop answers the velocities and strokes of an excavator to the "
            f"pilot pressures of Table A.1: {change}"
        )
