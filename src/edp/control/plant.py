"""Controller's view of a plant: measured channels, mapping from levers to commands, and machine geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import TipGeometry
from edp.errors import ConfigError, closest
from edp.signals import TABLE_A1, Channel, Kind

Array = NDArray[np.float64]
STROKES = ("CylStroke_1", "CylStroke_2", "CylStroke_3")
PILOTS = tuple(name for name, channel in TABLE_A1.items() if channel.kind is Kind.PILOT_PRESSURE)
VELOCITIES = ("CylVels_1", "CylVels_2", "CylVels_3")


@dataclass(frozen=True, eq=False)
class PlantInterface:
    """Controller's view of a plant: measured channels, mapping from levers to commands, and machine geometry.

    Attributes:
        channels: channels of an observation, in order; SI units.
        rate_hz: sampling rate in Hz.
        geometry: kinematics of the machine.
        command_channels: pilot pressures that levers command, in the order of `commands`.
        commands: nominal pilot pressures (Pa), shape (..., command), of lever positions, shape (..., 3).
        source: name of the plant in messages.
    """

    channels: tuple[Channel, ...]
    rate_hz: float
    geometry: TipGeometry
    command_channels: tuple[Channel, ...]
    commands: Callable[[Array], Array]
    source: str = "plant"

    def columns(self, names: tuple[str, ...]) -> NDArray[np.int64]:
        """Return the positions of channels in an observation.

        Raises:
            ConfigError: one is not measured; the closest is offered.
        """
        measured = [channel.name for channel in self.channels]
        for name in names:
            if name not in measured:
                raise ConfigError(f"{self.source} does not measure '{name}'{closest(name, measured)}")
        return np.array([measured.index(name) for name in names])


def interface_of(env: Any) -> PlantInterface:
    """Return the controller's view of an environment.

    Args:
        env: a gymnasium environment, or a batch of plants, with `channels`, `rate_hz`, `machine` and `commands` to the
            channels `PILOTS`, such as `edp.sim.environment.ExcavatorEnv` or
            `edp.control.twin_environment.TwinEnvironment`.
    """
    plain = getattr(env, "unwrapped", env)
    source = getattr(plain, "source", "the simulator")
    commands = tuple(TABLE_A1[name] for name in PILOTS)
    geometry = TipGeometry(plain.machine)
    return PlantInterface(tuple(plain.channels), float(plain.rate_hz), geometry, commands, plain.commands, source)
