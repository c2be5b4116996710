"""Data sets: which scenarios to simulate, and running them in several processes."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from edp.errors import ConfigError
from edp.jobs import Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import WorkUnit
from edp.recording import Recording
from edp.settings.bounds import MIN_MINUTES, above, check_bounds, integer, span
from edp.sim.excitation import EXCITATIONS
from edp.sim.faults import FaultSpec, faults_of
from edp.sim.machine.family import MASSES_T, WIDEST, member_mass, member_name
from edp.sim.machine.machine_files import load_machine
from edp.sim.physics.material import load_material
from edp.sim.scenario import LARGEST_STEP_S, START_STROKES, Scenario, scenario_to_dict
from edp.sim.simulate import simulate
from edp.storage.ledger import TrainingIdentity, WithState

DEFAULT_MIX: Mapping[str, float] = {
    "isolated": 0.23,
    "combined": 0.23,
    "grading": 0.16,
    "dig": 0.13,
    "aprbs": 0.10,
    "end_stops": 0.09,
    "reversals": 0.06,
}
"""Default fraction of the recordings per excitation."""

MAX_RECORDINGS, MAX_MINUTES, MAX_MACHINES, MAX_SEED = 100_000, 1e6, 1000, 2**63
"""Maximum number of recordings, minutes and machines, and maximum seed of a data set. A plan of this size takes some
seconds."""
BOUNDS = {
    "recordings": integer(1, MAX_RECORDINGS),
    "minutes": span(MIN_MINUTES, MAX_MINUTES),
    "seed": integer(0, MAX_SEED - 1),
    "family": integer(0, MAX_MACHINES),
    "scatter": above(0.0, WIDEST),
    "rate_hz": span(1.0, 1000.0),
    "step_s": above(0.0, LARGEST_STEP_S),
}
AIR = "air"
"""Name of free air in a mix of materials."""


@dataclass(frozen=True, kw_only=True)
class DataSetSpec:
    """Data set to simulate; equal settings give equal bits, for any number of workers.

    Attributes:
        machine: name of a machine, or path of a machine file.
        minutes: length of all recordings together.
        recordings: number of recordings of equal length.
        seed: random seed.
        family: number of random machines that replace `machine`; 0 uses `machine`.
        masses: lightest and heaviest machine of the family, t.
        scatter: scatter of the machines of the family about the laws of scaling: a factor, at most 2.5.
        mix: fraction of the recordings per excitation.
        materials: fraction of the recordings per soil, for excitations that work the ground (grading, dig); ``air`` is
            free air. All other excitations move in free air.
        rate_hz: samples per second.
        step_s: integration step, s.
        start_strokes: range of the initial strokes, as fractions of the full stroke.
        sensor_noise: whether logs have sensor errors; False logs the true values.
        sensors: values that replace those of the machine's ``[sensors]``.
        faults: faults of machine and sensors in every recording; see `edp.sim.faults`.

    Raises:
        ConfigError: a value is out of range or a name is unknown.
    """

    machine: str = "M22"
    minutes: float = 60.0
    recordings: int = 30
    seed: int = 0
    family: int = 0
    masses: tuple[float, float] = MASSES_T
    scatter: float = 1.0
    mix: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_MIX))
    materials: Mapping[str, float] = field(default_factory=dict)
    rate_hz: float = 100.0
    step_s: float = 1e-3
    start_strokes: tuple[float, float] = START_STROKES
    sensor_noise: bool = True
    sensors: Mapping[str, object] = field(default_factory=dict)
    faults: tuple[FaultSpec, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "faults", faults_of(self.faults, "data set"))
        check_bounds("data set", self, **BOUNDS)
        if not self.family and tuple(self.masses) != MASSES_T:
            raise ConfigError(f"masses = {list(self.masses)} are those of a family; say how many machines with family")
        if not self.family and self.scatter != 1.0:
            raise ConfigError(f"scatter = {self.scatter} is that of a family; say how many machines with family")
        # The name identifies the machine, so rounding the name would select another machine.
        if self.scatter != round(self.scatter, 3):
            raise ConfigError(f"scatter = {self.scatter} has more than three decimals; names of machines hold three")
        member_mass(self.seed, 0, *self.masses)
        if any(mass != round(mass, 3) for mass in self.masses):
            raise ConfigError(f"masses = {list(self.masses)} t must be whole kilograms: names of machines hold them")
        for name in self.mix:
            EXCITATIONS[name]
        _check_shares("mix", self.mix)
        for name in self.materials:
            if name != AIR:
                load_material(name)
        if self.materials:
            _check_shares("materials", self.materials)
            if not any(EXCITATIONS[name].works_ground and share > 0 for name, share in self.mix.items()):
                working = ", ".join(name for name in EXCITATIONS if EXCITATIONS[name].works_ground)
                raise ConfigError(f"materials are given, but no family of mix works the ground; add one of {working}")

    def scenarios(self) -> tuple[Scenario, ...]:
        """Return equally long scenarios, each with its own seed derived from `seed`; only these seeds depend on it."""
        seeds = np.random.SeedSequence(self.seed).spawn(self.recordings)
        excitations = hand_out(self.mix, self.recordings)
        soils = self._soils(excitations)
        label = load_machine(self.machine).name.lower()
        plan = tuple(
            Scenario(
                machine=self.machine,
                excitation=excitations[i],
                # Hundredths of a second, which are whole samples at 100 Hz.
                duration_s=round(self.minutes * 60.0 / self.recordings, 2),
                rate_hz=self.rate_hz,
                step_s=self.step_s,
                sensor_noise=self.sensor_noise,
                # 32 bits, which every generator and JSON hold.
                seed=int(seeds[i].generate_state(1)[0]),
                name="_".join(part for part in (label, f"{i:03d}", excitations[i], Path(soils[i]).stem) if part),
                material=soils[i],
                start_strokes=self.start_strokes,
                sensors=self.sensors,
                faults=self.faults,
            )
            for i in range(self.recordings)
        )
        return distribute_over_family(plan, self.family, self.seed, self.masses, self.scatter) if self.family else plan

    def _soils(self, excitations: Sequence[str]) -> list[str]:
        """Return the material of each recording; empty for free air. Each family gets all materials in turn."""
        soils = [""] * len(excitations)
        places = [i for i in _sort_by_family(excitations) if EXCITATIONS[excitations[i]].works_ground]
        if self.materials:
            for recording_index, chosen in zip(places, hand_out(self.materials, len(places)), strict=True):
                soils[recording_index] = "" if chosen == AIR else chosen
        return soils


def _sort_by_family(excitations: Sequence[str]) -> list[int]:
    """Return the recording indices sorted by family."""
    return sorted(range(len(excitations)), key=lambda i: excitations[i])


def _check_shares(what: str, shares: Mapping[str, float]) -> None:
    for name, share in shares.items():
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share < math.inf:
            raise ConfigError(f"{what}: share {share!r} of '{name}' must not be negative, and a number")
    if not sum(shares.values()) > 0:
        raise ConfigError(f"{what}: the shares add up to nothing; give at least one a positive share")


def plan_data_set(
    machine: str,
    minutes: float,
    recordings: int,
    seed: int,
    mix: Mapping[str, float] | None = None,
    materials: Mapping[str, float] | None = None,
) -> tuple[Scenario, ...]:
    """Return the scenarios of a `DataSetSpec`.

    Raises:
        ConfigError: a count or length is not positive, or mix or materials name what is unknown.
    """
    shares = dict(DEFAULT_MIX if mix is None else mix)
    spec = DataSetSpec(
        machine=machine, minutes=minutes, recordings=recordings, seed=seed, mix=shares, materials=materials or {}
    )
    return spec.scenarios()


def distribute_over_family(
    scenarios: Sequence[Scenario],
    count: int,
    seed: int,
    masses: tuple[float, float] = MASSES_T,
    scatter: float = 1.0,
) -> tuple[Scenario, ...]:
    """Distribute the scenarios over `count` machines of other sizes, in turn per excitation; see `machine_family`.

    Raises:
        ConfigError: the count is not positive.
    """
    if count < 1:
        raise ConfigError(f"family = {count} machines; at least one is needed")
    turns = {
        recording_index: turn % count
        for turn, recording_index in enumerate(_sort_by_family([s.excitation for s in scenarios]))
    }
    names = [member_name(seed, turns[i], masses, scatter) for i in range(len(scenarios))]
    return tuple(
        replace(s, machine=n, name=_rename_recording(s.name, n)) for s, n in zip(scenarios, names, strict=True)
    )


def _rename_recording(name: str, machine: str) -> str:
    return "_".join([machine, *name.split("_", 1)[1:]])


def hand_out(shares: Mapping[str, float], count: int) -> list[str]:
    """Return `count` names in the given proportions, mixed so that any leading part has these proportions, too.

    Each name occurs once, in descending proportion; then Webster's method selects the name with the largest deficit.
    """
    counts = {name: 0 for name, share in sorted(shares.items(), key=lambda entry: (-entry[1], entry[0])) if share > 0}
    names = []
    for turn in range(count):
        waiting = counts if turn >= len(counts) else [name for name, n in counts.items() if n == 0]
        names.append(max(waiting, key=lambda name: shares[name] / (2 * counts[name] + 1)))
        counts[names[-1]] += 1
    return names


def simulate_many(
    scenarios: Sequence[Scenario], workers: int = 1, on_done: Callable[[Recording], None] | None = None
) -> Iterator[Recording]:
    """Simulate scenarios in `workers` processes and yield their recordings in order.

    The recordings do not depend on the number of workers: each scenario carries its own seed.

    Raises:
        SimulationError: a simulation diverged.
        LostError: a worker process was killed again and again.
    """
    for recording in map(simulate, scenarios) if workers == 1 else _simulate_together(scenarios, workers):
        if on_done is not None:
            on_done(recording)
        yield recording


def _simulate_together(scenarios: Sequence[Scenario], workers: int) -> Iterator[Recording]:
    units = [
        WorkUnit(
            f"{__name__}:simulate_unit",
            f"simulation of '{scenario.label}'",
            scenario_to_dict(scenario),
            machine_hash(scenario),
        )
        for scenario in scenarios
    ]
    for result in Workers(count=workers).map_in_order(units):
        yield unpack(result.content or b"", Recording)


def simulate_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Simulate the scenario of a unit and return its recording."""
    return WithState({}, pack(simulate(scenario_of_unit(identity.config, identity.data))))


def scenario_of_unit(values: Mapping[str, Any], expected_hash: str) -> Scenario:
    """Return the scenario of a unit.

    Raises:
        ConfigError: the machine file differs on this node.
    """
    scenario = Scenario(**values)
    if machine_hash(scenario) != expected_hash:
        raise ConfigError(
            f"machine '{scenario.machine}' has other numbers on this node; all nodes must see the same file there"
        )
    return scenario


def machine_hash(scenario: Scenario) -> str:
    """Return the hash of the parameters of a scenario's machine, which may come from a file."""
    return hashlib.blake2b(repr(scenario.load()).encode(), digest_size=16).hexdigest()
