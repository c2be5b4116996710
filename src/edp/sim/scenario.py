"""One recording to simulate, checked before the first step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

from edp.errors import ConfigError, EdpError
from edp.sim.excitation import EXCITATIONS
from edp.sim.faults import FaultSpec, faults_of
from edp.sim.machine.machine import Machine, Sensors
from edp.sim.machine.machine_checks import MACHINE_FILE, check_machine
from edp.sim.machine.machine_files import load_machine
from edp.sim.physics.material import load_material
from edp.sim.physics.motor_circuit import motors_of
from edp.sim.physics.plant import steps_per_sample

START_STROKES = (0.3, 0.7)
"""Range of the initial strokes (fractions of the full stroke), away from both ends, where the first move would meet a
cushion."""
LARGEST_STEP_S = 2.5e-3
"""Maximum integration step, s. At 1 to 2 ms the order of convergence is 1.8 in hard reversals (docs, known gaps)."""


class SimulationError(EdpError):
    """A simulation failed: the state diverged, or a worker process died."""


@dataclass(frozen=True)
class Scenario:
    """One recording to simulate.

    Attributes:
        machine: name of a machine, or path of a machine file (`.toml`).
        excitation: name in `EXCITATIONS`.
        duration_s: length of the recording, s.
        rate_hz: samples per second, also the rate of commands.
        step_s: integration step, s; it is divided by four near the ends of the stroke.
        sensor_noise: whether logs have sensor errors; False logs the true values.
        material: soil that the bucket works in, see `edp.sim.physics.material.material_names`; empty for free air.
        start_strokes: range of the initial strokes, as fractions of the full stroke.
        sensors: values that replace those of the machine's ``[sensors]``, by key: to switch faults on or off.
        seed: random seed. Equal seeds give equal bits on the same machine.
        faults: faults of machine and sensors, each as a text or as a table; see `edp.sim.faults`.
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
    material: str = ""
    start_strokes: tuple[float, float] = START_STROKES
    sensors: Mapping[str, object] = field(default_factory=dict)
    faults: tuple[FaultSpec, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_strokes", tuple(self.start_strokes))
        object.__setattr__(self, "faults", faults_of(self.faults, "scenario"))
        machine = self.load()
        if EXCITATIONS[self.excitation].swings:
            # For its refusal only: the plant asks for the motors again.
            motors_of(machine)
        if self.material:
            load_material(self.material)
        for key in ("duration_s", "rate_hz", "step_s"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"scenario: {key} = {value} must be a positive number")
        if self.duration_s * self.rate_hz < 2:
            raise ConfigError(f"scenario: duration_s = {self.duration_s} is less than two samples; make it longer")
        if self.step_s > LARGEST_STEP_S:
            raise ConfigError(f"scenario: step_s = {self.step_s} is above {LARGEST_STEP_S} s, where accuracy is lost")
        # For its refusal only: the plant asks for the number again.
        steps_per_sample(self.rate_hz, self.step_s)
        if self.seed < 0:
            raise ConfigError(f"scenario: seed = {self.seed} must not be negative")
        low, high = self.start_strokes
        if not 0.0 <= low <= high <= 1.0:
            raise ConfigError(f"scenario: start_strokes = {[low, high]} must be shares with 0 <= low <= high <= 1")

    def load(self) -> Machine:
        """Return the machine with the scenario's sensors.

        Raises:
            ConfigError: unknown machine or sensor value, or one out of its bounds.
        """
        machine = load_machine(self.machine)
        if not self.sensors:
            return machine
        where = f"{machine.name} with the scenario's sensors"
        values = {**MACHINE_FILE.to_dict(machine.sensors), **self.sensors}
        changed = replace(machine, sensors=MACHINE_FILE.build(Sensors, values, where))
        check_machine(changed, where)
        return changed

    @property
    def samples(self) -> int:
        """Number of samples."""
        return round(self.duration_s * self.rate_hz)

    @property
    def label(self) -> str:
        """Name of the recording."""
        return self.name or f"{load_machine(self.machine).name.lower()}_{self.excitation}_{self.seed}"


def scenario_to_dict(scenario: Scenario) -> dict[str, object]:
    """Convert a scenario to JSON types; `Scenario(**plain(s)) == s`."""
    values = {entry.name: getattr(scenario, entry.name) for entry in fields(scenario)}
    values |= {"start_strokes": list(scenario.start_strokes), "sensors": dict(scenario.sensors)}
    # Add faults only if there are any, so that data sets without faults keep their identity.
    del values["faults"]
    return values | ({"faults": [fault.to_dict() for fault in scenario.faults]} if scenario.faults else {})
