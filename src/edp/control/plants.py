"""Plants by one argument: the simulator, or a twin that was trained on recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edp.control.twin_environment import TwinEnvironment
from edp.errors import ConfigError
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
from edp.training.twin_bundle import load_twin


def plant_of(machine: str, duration_s: float, rate_hz: float, twin: str | Path | None = None) -> Any:
    """An environment in which a controller can be run.

    Args:
        machine: name of a machine, or path of a machine file: simulated, or the kinematics of a twin.
        duration_s: longest loop.
        rate_hz: ticks per second.
        twin: run folder of a twin that takes the simulator's place.

    Raises:
        ConfigError: gymnasium is not installed, or the twin is of another rate or machine.
    """
    if twin is None:
        return ExcavatorEnv(EnvironmentSpec(machine=machine, duration_s=duration_s, rate_hz=rate_hz))
    plant = load_twin(twin).twin
    if plant.channels.rate_hz != rate_hz:
        raise ConfigError(
            f"twin '{twin}' has {plant.channels.rate_hz:g} Hz, the loops {rate_hz:g} Hz; set rate_hz = "
            f"{plant.channels.rate_hz:g}"
        )
    return TwinEnvironment(plant, machine, duration_s)
