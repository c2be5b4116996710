"""Sessions of an M22 at work for the monitor: healthy, faulty, and healthy ones that must not raise an alarm.

    python benchmarks/monitor_sessions.py --data SESSIONS --parts training validation

Each session is 8 min of work that mixes all ways of driving: in free air all of them, in soil those that work the
ground, with short stands in between; oil of 20 to 65 degC at the start, 0 to 35 degC outside. Seeds of the parts are
apart: training and validation may be used to build a monitor, `test` is for `benchmarks/monitor.py` alone.

A session is a float32 array beside a JSON file: channels of Table A.1, strokes, pump pressures and oil temperature with
the noise of real sensors. What only the simulator knows is in the JSON file: the fault, and when the machine moved.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.monitor.residuals.base import ONE_BY_ONE, SideBySide
from edp.recording import Recording
from edp.signals import TABLE_A1, VOCABULARY
from edp.sim import Scenario, simulate
from edp.sim.excitation import EXCITATIONS
from edp.sim.excitation.base import AXES, Excitation
from edp.sim.faults import FAULTS, fault_text, ladder
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import load_machine
from edp.sim.plan import DEFAULT_MIX, hand_out
from edp.sim.view import View
from edp.storage import make_folder, read_json, write_bytes, write_json
from edp.training.identification.machine_text import machine_text

Floats = NDArray[np.float64]
CHANNELS = (*TABLE_A1, *(f"CylStroke_{i}" for i in (1, 2, 3)), *(f"PumpPressure_{i}" for i in (1, 2)), "OilTemperature")
"""What a well-equipped machine measures."""
NOISE = {"CylStroke": 1e-4, "PumpPressure": 1.5e4, "OilTemperature": 0.1}
"""rms in SI units of sensors that the simulator shows without noise: a magnetostrictive stroke sensor, the transmitters
of the cylinder pressures, a thermometer of a data bus."""
RATE_HZ = 100.0
DURATION_S, ONSET_S = 480.0, 120.0
SEGMENT_S, STAND_S, STAND_SHARE = (25.0, 55.0), (3.0, 10.0), 0.3
OIL, OUTSIDE = (20.0, 65.0), (0.0, 35.0)
"""degC."""
SOILS = ("", "sandy_loam", "", "clay")
"""In turn; empty is free air. Gravel and dry sand are for the nuisance sets."""
MOVING_RAD_S = 0.005
"""A joint that turns faster moves the machine: some mm/s of its cylinder."""
PARTS = {"training": 1_000_000, "validation": 2_000_000, "test": 3_000_000}
"""Seeds of a part: from here on, far fewer than a million."""
NUISANCES = {
    "gravel": {"soils": ("gravel",)},
    "dry_sand": {"soils": ("dry_sand",)},
    "oil_78": {"oil": (78.0, 78.0), "outside": (30.0, 40.0)},
    "oil_5": {"oil": (5.0, 5.0), "outside": (-5.0, 5.0)},
    "sister_1": {"tolerance": 0.01},
    "sister_3": {"tolerance": 0.03},
}
COUNTS = {
    "training": {"healthy": 360, "faulty": 0, "nuisance": 0},
    "validation": {"healthy": 120, "faulty": 1, "nuisance": 6},
    "test": {"healthy": 182, "faulty": 1, "nuisance": 8},
}
"""Healthy sessions; draws of each kind and size of fault; sessions of each nuisance set."""


@dataclass(frozen=True)
class SessionPlan:
    """What is simulated.

    Attributes:
        name: of the session, which begins with its group.
        group: ``healthy``, ``faulty`` or a name of `NUISANCES`.
        seed: of all that is random.
        oil_c: temperature of the oil at the start.
        outside_c: temperature outside.
        soil: material; empty for free air.
        tolerance: of the numbers of a sister machine, as a share; 0 for the machine itself.
        fault: its text; empty for none.
        seconds: length.
    """

    name: str
    group: str
    seed: int
    oil_c: float
    outside_c: float
    soil: str = ""
    tolerance: float = 0.0
    fault: str = ""
    seconds: float = DURATION_S


@dataclass(frozen=True, eq=False)
class Session:
    """A simulated session.

    Attributes:
        plan: what was simulated.
        recording: measured channels.
        moving: ticks of each second in which the machine moved, shape (seconds,).
    """

    plan: SessionPlan
    recording: Recording
    moving: NDArray[np.int64]


@EXCITATIONS.register("session")
class MixedWork(Excitation):
    """One way of driving after another, each for `SEGMENT_S`, with stands in between."""

    AIR = tuple(DEFAULT_MIX)
    GROUND = tuple(name for name in DEFAULT_MIX if EXCITATIONS[name].works_ground)

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._left = 0
        self._queue: list[str] = []
        self._driver: Excitation | None = None

    @property
    def by_hand(self) -> bool:  # type: ignore[override]
        """Of the way that is driven now."""
        return self._driver is None or self._driver.by_hand

    def block(self, view: View) -> Floats:
        """Of the present driver, or a stand."""
        if self._left <= 0 or self._driver is None:
            if self._driver is not None and self._rng.random() < STAND_SHARE:
                self._driver = None
                return np.zeros((round(self._rng.uniform(*STAND_S) * self._rate), AXES))
            self._driver = self._drawn(not np.isnan(view.ground))
        targets = self._driver.block(view)
        self._left -= len(targets)
        return targets

    def _drawn(self, over_ground: bool) -> Excitation:
        if not self._queue:
            ways = self.GROUND if over_ground else self.AIR
            self._queue = hand_out({way: DEFAULT_MIX[way] for way in ways}, 2 * len(ways))
            self._rng.shuffle(self._queue)
        self._left = round(self._rng.uniform(*SEGMENT_S) * self._rate)
        return EXCITATIONS[self._queue.pop()](self._rng, self._rate, self._machine)


def session_plans(part: str, group: str, count: int, seconds: float = DURATION_S) -> list[SessionPlan]:
    """Plans of a part.

    Args:
        part: name in `PARTS`.
        group: ``healthy``, ``faulty`` or a name of `NUISANCES`.
        count: sessions; of faulty ones, draws of every kind and size of the ladder, each at a site of its own.
        seconds: length of a session.
    """
    places = ("healthy", "faulty", *NUISANCES)
    # Room for 100,000 sessions a group.
    first = PARTS[part] + 100_000 * places.index(group)
    faults = faults_of_draws(count, first, seconds) if group == "faulty" else [""] * count
    return [_plan(group, number, first + number, fault, seconds) for number, fault in enumerate(faults)]


def _plan(group: str, number: int, seed: int, fault: str, seconds: float) -> SessionPlan:
    changes: dict[str, Any] = NUISANCES.get(group, {})
    rng = np.random.default_rng([seed, 7])
    oil, outside = rng.uniform(*changes.get("oil", OIL)), rng.uniform(*changes.get("outside", OUTSIDE))
    soils = changes.get("soils", SOILS)
    words = fault.partition("@")[0].replace(":", "-").replace("/", "_").replace("%", "pct")
    name = f"{group}_{number:03d}" + (f"_{words}" if words else "")
    tolerance = changes.get("tolerance", 0.0)
    soil = soils[int(rng.integers(len(soils)))]
    return SessionPlan(name, group, seed, float(oil), float(outside), soil, tolerance, fault, seconds)


def faults_of_draws(draws: int, seed: int, seconds: float = DURATION_S) -> list[str]:
    """Every size of every kind, `draws` times, each at a site drawn anew; from a quarter of the session on."""
    rng = np.random.default_rng(seed)
    texts = []
    for _ in range(draws):
        for fault in ladder(onset_s=ONSET_S * seconds / DURATION_S):
            sites = FAULTS[fault.kind].sites
            texts.append(fault_text(replace(fault, site=str(rng.choice(sites)) if sites else "")))
    return texts


def sister(machine: Machine, tolerance: float, rng: np.random.Generator) -> Machine:
    """Create a machine of the same series, with parameters drawn uniformly within the production tolerance.

    Pins, lengths, bores and strokes stay: they are machined to less than a thousandth.
    """
    parts = {
        "bodies": ("mass", "com_x", "com_y", "inertia"),
        "cylinders": ("hose_volume", "piston_leakage", "spool_leakage"),
        "friction": ("coulomb_fraction", "static_fraction", "viscous"),
        "oil": ("bulk_modulus", "air_fraction", "viscosity", "heat_capacity", "cooling", "tank_pressure"),
        "pumps": ("max_flow", "power_limit", "time_constant", "relief", "min_displacement"),
        "valves": (
            *("pilot_pressure", "pilot_frequency", "spool_frequency", "conflux_spool_frequency", "dead_time"),
            *("dead_band_extend", "dead_band_retract", "conflux_dead_band_extend", "conflux_dead_band_retract"),
            *("meter_in_extend", "meter_in_retract", "conflux_in_extend", "conflux_in_retract", "hysteresis"),
            *("meter_out_extend", "meter_out_retract", "regeneration_extend", "regeneration_retract"),
            *("port_relief_head", "port_relief_rod"),
        ),
    }

    def scattered(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(scattered(entry) for entry in value)
        return float(value * (1.0 + rng.uniform(-tolerance, tolerance)))

    changed = {}
    for part, keys in parts.items():
        table = getattr(machine, part)
        changed[part] = replace(table, **{key: scattered(getattr(table, key)) for key in keys})
    return replace(machine, **changed)


def machine_of(plan: SessionPlan) -> Machine:
    """M22, or a sister of it, with the temperatures of a session."""
    machine = load_machine("M22")
    if plan.tolerance:
        machine = sister(machine, plan.tolerance, np.random.default_rng([plan.seed, 8]))
    return replace(machine, oil=replace(machine.oil, temperature=plan.oil_c, ambient=plan.outside_c))


def measured(recording: Recording, seed: int) -> NDArray[np.float32]:
    """Return the channels of a machine with sensor noise, which the simulation omits, shape (time, CHANNELS)."""
    rng = np.random.default_rng([seed, 9])
    values = np.stack([recording.column(name) for name in CHANNELS], axis=1)
    for column, name in enumerate(CHANNELS):
        size = NOISE.get(name.rpartition("_")[0] or name, 0.0)
        if size:
            values[:, column] += (size * rng.normal(size=len(values))).astype(np.float32)
    for fault in recording.meta.get("faults", ()):
        # A sensor that is stuck has no noise either.
        if fault["kind"] == "stroke_stuck":
            column = CHANNELS.index("CylStroke_1") + ("boom", "arm", "bucket").index(fault["site"])
            tick = round(fault.get("onset_s", 0.0) * recording.rate_hz)
            values[tick:, column] = values[tick, column]
    return np.ascontiguousarray(values, dtype=np.float32)


def moving_of(recording: Recording) -> NDArray[np.int64]:
    """Ticks of each second in which a joint turns."""
    rates = np.stack([recording.column(f"JointVel_{i}") for i in (1, 2, 3)], axis=1)
    moves = (np.abs(rates) > MOVING_RAD_S).any(axis=1)
    ticks = round(recording.rate_hz)
    whole = len(moves) // ticks * ticks
    counts: NDArray[np.int64] = moves[:whole].reshape(-1, ticks).sum(axis=1)
    return counts


def simulated(plan: SessionPlan, machines: Path) -> Session:
    """Simulate a session; its machine file goes to `machines`."""
    path = machines / f"{plan.name}.toml"
    write_bytes(path, machine_text(machine_of(plan), [], {}).encode())
    faults = (plan.fault,) if plan.fault else ()
    scenario = Scenario(
        machine=str(path), excitation="session", duration_s=plan.seconds, rate_hz=RATE_HZ, seed=plan.seed,
        name=plan.name, material=plan.soil, faults=faults,
    )  # fmt: skip
    recording = simulate(scenario)
    return Session(plan, _recording(plan, measured(recording, plan.seed)), moving_of(recording))


def _recording(plan: SessionPlan, values: NDArray[np.float32]) -> Recording:
    channels = tuple(VOCABULARY[name] for name in CHANNELS)
    return Recording(plan.name, channels, values, RATE_HZ, "sim:M22", {"machine": "M22"})


@dataclass(frozen=True)
class _Job:
    plan: SessionPlan
    folder: Path
    label: str


def _write(job: _Job) -> str:
    session = simulated(job.plan, make_folder(job.folder / "machines"))
    buffer = BytesIO()
    np.save(buffer, session.recording.values)
    write_bytes(job.folder / f"{job.plan.name}.npy", buffer.getvalue())
    # Last: what has a JSON file is whole.
    write_json(job.folder / f"{job.plan.name}.json", {"plan": asdict(job.plan), "moving": session.moving.tolist()})
    return job.plan.name


def write_sessions(plans: Sequence[SessionPlan], folder: Path, side_by_side: SideBySide = ONE_BY_ONE) -> None:
    """Simulate what is not in the folder yet."""
    make_folder(folder)
    jobs = [_Job(plan, folder, plan.name) for plan in plans if not (folder / f"{plan.name}.json").exists()]
    for number, _ in enumerate(side_by_side(_write, jobs), start=1):
        if number % 50 == 0 or number == len(jobs):
            print(f"{folder.name}: {number} of {len(jobs)}", flush=True)


def read_session(folder: Path, name: str) -> Session:
    """Read a session by its name, such as ``healthy_000``."""
    plan, moving = session_facts(folder, name)
    values = np.load(folder / f"{name}.npy", allow_pickle=False)
    return Session(plan, _recording(plan, values), moving)


def session_facts(folder: Path, name: str) -> tuple[SessionPlan, NDArray[np.int64]]:
    """Return the plan of a session and the number of samples in motion for each second."""
    facts = read_json(folder / f"{name}.json")
    return SessionPlan(**facts["plan"]), np.array(facts["moving"])


def session_names(folder: Path, group: str) -> list[str]:
    """Names of the sessions of a group that are there, in order."""
    return sorted(path.stem for path in folder.glob(f"{group}_*.json"))


def read_sessions(folder: Path, group: str, first: int = 0, count: int | None = None) -> Iterator[Session]:
    """Sessions of a group, one by one: each has 6 MB."""
    names = session_names(folder, group)[first:]
    for name in names if count is None else names[:count]:
        yield read_session(folder, name)


def plans_of(part: str, counts: dict[str, int], seconds: float = DURATION_S) -> list[SessionPlan]:
    """All plans of a part: healthy first, then faulty, then nuisance sets."""
    plans = session_plans(part, "healthy", counts["healthy"], seconds)
    plans += session_plans(part, "faulty", counts["faulty"], seconds)
    for group in NUISANCES:
        plans += session_plans(part, group, counts["nuisance"], seconds)
    return plans


class Processes:
    """Calls a function for each of some jobs in processes, also from several threads of this one.

    Args:
        executor: the processes.
    """

    is_elsewhere = True

    def __init__(self, executor: ProcessPoolExecutor) -> None:
        self.executor = executor

    def __call__(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterable[Any]:
        """Yield ``function(job)`` of each job, in order."""
        return self.executor.map(function, jobs)


@contextmanager
def processes(count: int) -> Iterator[SideBySide]:
    """Yield what calls functions in `count` processes, which end with the block; in this process for 1."""
    if count == 1:
        yield ONE_BY_ONE
        return
    with ProcessPoolExecutor(count, get_context("spawn")) as executor:
        yield Processes(executor)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the sessions; a folder a part")
    options.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    options.add_argument("--workers", type=int, default=2)
    given = options.parse_args()
    with processes(given.workers) as side_by_side:
        for part in given.parts:
            write_sessions(plans_of(part, COUNTS[part]), given.data / part, side_by_side)


if __name__ == "__main__":
    main()
