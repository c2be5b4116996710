"""Scenarios and their recordings: the simulator's front door."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, EdpError
from edp.recording import Recording
from edp.signals import EXTRA_CHANNELS, GROUND_CHANNELS, TABLE_A1
from edp.sim import layout as at
from edp.sim import sensors
from edp.sim.machine import Machine
from edp.sim.machine_files import load_machine
from edp.sim.operator import EXCITATIONS
from edp.sim.plant import Plant

Array = NDArray[np.float64]
START_STROKES = (0.3, 0.7)


class SimulationError(EdpError):
    """A simulation failed: the state diverged, or a worker process died."""


@dataclass(frozen=True)
class Scenario:
    """One recording to simulate.

    Attributes:
        machine: name of a machine, or path of a machine file (`.toml`).
        excitation: name in `EXCITATIONS`.
        duration_s: length of the recording.
        rate_hz: samples per second, also the rate of commands.
        step_s: integration step; cut in four near the ends of the stroke.
        sensor_noise: False logs the truth.
        seed: the same seed gives the same bits on the same machine.
        name: name of the recording; empty builds one from machine, excitation and seed.

    Raises:
        ConfigError: a value is out of range, or machine or excitation are unknown (the closest is offered).
    """

    machine: str = "M22"
    excitation: str = "combined"
    duration_s: float = 120.0
    rate_hz: float = 100.0
    step_s: float = 1e-3
    sensor_noise: bool = True
    seed: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        load_machine(self.machine)
        EXCITATIONS[self.excitation]
        for key in ("duration_s", "rate_hz", "step_s"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"scenario: {key} = {value} must be a positive number")
        if self.duration_s * self.rate_hz < 2:
            raise ConfigError(f"scenario: duration_s = {self.duration_s} is less than two samples; make it longer")
        if self.step_s > 2.5e-3:
            raise ConfigError(f"scenario: step_s = {self.step_s} is above 0.0025 s, where accuracy is lost")
        if self.seed < 0:
            raise ConfigError(f"scenario: seed = {self.seed} must not be negative")

    @property
    def samples(self) -> int:
        """Number of samples."""
        return round(self.duration_s * self.rate_hz)

    @property
    def label(self) -> str:
        """Name of the recording."""
        return self.name or f"{load_machine(self.machine).name.lower()}_{self.excitation}_{self.seed}"


def simulate(scenario: Scenario, progress: Callable[[float], None] | None = None) -> Recording:
    """Simulate one scenario.

    Args:
        scenario: what to simulate.
        progress: called with the share done, 0 to 1, now and then.

    Returns:
        The 24 channels of Table A.1 as sensors show them, then `EXTRA_CHANNELS` without noise; float32, SI units.

    Raises:
        SimulationError: the state became non-finite.
    """
    machine = load_machine(scenario.machine)
    start, hand, noise = (np.random.default_rng(s) for s in np.random.SeedSequence(scenario.seed).spawn(3))
    plant = Plant(machine, start.uniform(*START_STROKES, 3), scenario.rate_hz, scenario.step_s)
    operator = EXCITATIONS[scenario.excitation](hand, scenario.rate_hz)
    logs: list[Array] = []
    done = 0
    while done < scenario.samples:
        targets = operator.block(plant.strokes)[: scenario.samples - done]
        logs.append(plant.follow(targets))
        done += len(targets)
        if not np.isfinite(logs[-1]).all():
            raise SimulationError(
                f"simulation '{scenario.label}' diverged before t = {done / scenario.rate_hz:.2f} s "
                f"(machine {scenario.machine}, seed {scenario.seed}); choose a smaller step_s than {scenario.step_s}"
            )
        if progress is not None:
            progress(done / scenario.samples)
    return _recording(scenario, machine, np.concatenate(logs), plant.clamps, noise if scenario.sensor_noise else None)


def _recording(
    scenario: Scenario, machine: Machine, log: Array, clamps: int, noise: np.random.Generator | None
) -> Recording:
    measured = sensors.measured_signals(log, machine, scenario.rate_hz, noise, log[:, at.LOG_OIL] + 273.15)
    truth = sensors.truth_signals(log)
    extra = {name: channel for name, channel in {**EXTRA_CHANNELS, **GROUND_CHANNELS}.items() if name in truth}
    facts = {key: value for key, value in asdict(scenario).items() if key != "name"}
    return Recording(
        name=scenario.label,
        channels=(*TABLE_A1.values(), *extra.values()),
        values=np.column_stack([measured, *(truth[name] for name in extra)]).astype(np.float32),
        rate_hz=scenario.rate_hz,
        source=f"sim:{machine.name}",
        meta={**facts, "clamps": clamps},
    )
