"""Scenarios and their recordings: the simulator's front door."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.recording import Recording
from edp.signals import EXTRA_CHANNELS, FAULT_CHANNELS, GROUND_CHANNELS, MOTOR_CHANNELS, TABLE_A1
from edp.sim.excitation import EXCITATIONS
from edp.sim.faults.course import MachineCourse, SensorCourse, numbers_of, shares_at, spare_s
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import look_up_mass
from edp.sim.physics.plant import Plant
from edp.sim.physics.snapshot import Snapshot, capture, restored
from edp.sim.scenario import Scenario, SimulationError, scenario_to_dict
from edp.sim.sensors import draws, sensors
from edp.sim.start import seeds_of, start_of
from edp.sim.view import view_of

Array = NDArray[np.float64]


class Simulation:
    """Running simulation of a scenario, with snapshots and branches.

    Args:
        scenario: scenario to simulate.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        machine = scenario.load()
        hand = np.random.default_rng(seeds_of(scenario)[1])
        self.machine = machine
        ground, strokes = start_of(scenario, machine)
        swings, spare = EXCITATIONS[scenario.excitation].swings, spare_s(scenario.faults)
        self.plant = Plant(machine, strokes, scenario.rate_hz, scenario.step_s, ground, spare, swings)
        self._course = MachineCourse(scenario.faults, numbers_of(self.plant))
        self.operator = EXCITATIONS[scenario.excitation](hand, scenario.rate_hz, machine)
        self.samples = 0
        self._hand = hand
        self._waiting = np.zeros((0, self.operator.levers()))
        self._logs: list[Array] = []
        self._targets: list[Array] = []

    @property
    def log(self) -> Array:
        """Log until now, shape (samples, LOG_COLUMNS)."""
        return np.concatenate(self._logs) if self._logs else np.zeros((0, at.LOG_COLUMNS))

    @property
    def targets(self) -> Array:
        """Lever targets since this object was made or restored, shape (time, levers)."""
        return np.concatenate(self._targets) if self._targets else np.zeros((0, self.operator.levers()))

    def run(self, samples: int, progress: Callable[[float], None] | None = None) -> Array:
        """Run for `samples`; the rows that were logged in them, shape (samples, LOG_COLUMNS).

        Running in segments gives the same bits as running at once.

        Raises:
            SimulationError: the state became non-finite.
        """
        first, end = len(self._logs), self.samples + samples
        while self.samples < end:
            if len(self._waiting) == 0:
                self._waiting = self.operator.block(view_of(self.plant))
            now, self._waiting = self._waiting[: end - self.samples], self._waiting[end - self.samples :]
            self.follow(now)
            if progress is not None:
                progress(self.samples / self.scenario.samples)
        return np.concatenate(self._logs[first:])

    def follow(self, targets: Array) -> Array:
        """Run with lever targets given from outside, shape (samples, levers), as the operator's were; returns the log.

        Raises:
            SimulationError: the state became non-finite.
        """
        rows = self._advance(targets)
        self.samples += len(rows)
        # Check once per block, because a non-finite state persists.
        if not self.plant.finite:
            scenario = self.scenario
            raise SimulationError(
                f"simulation '{scenario.label}' diverged before t = {self.samples / scenario.rate_hz:.2f} s "
                f"(machine {scenario.machine}, seed {scenario.seed}); choose a smaller step_s than {scenario.step_s}"
            )
        self._logs.append(rows)
        self._targets.append(targets)
        return rows

    def _advance(self, targets: Array) -> Array:
        """Advance the plant with parameters that follow the faults sample by sample."""
        run = self.plant.follow if self.operator.by_hand else self.plant.run
        if not self._course.faults:
            return run(targets)
        live, rows = numbers_of(self.plant), []
        for first, behind in self._course.pieces(self.samples, self.samples + len(targets)):
            self._course.write(first, live)
            rows.append(run(targets[first - self.samples : behind - self.samples]))
        return np.concatenate(rows)

    def recording(self) -> Recording:
        """Return the recorded signals of the log until now."""
        return _recording(self.scenario, self.machine, self.log, self.plant.clamps)

    def snapshot(self) -> Snapshot:
        """Return a snapshot of plant, operator, random state and log, independent of later steps."""
        arrays: list[NDArray[Any]] = []
        state = capture({key: getattr(self, key) for key in _CHANGING}, arrays)
        return Snapshot(scenario_to_dict(self.scenario), self.samples, state, tuple(arrays), tuple(self._logs))

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of the same scenario; the following samples have identical bits.

        Raises:
            SimulationError: the snapshot belongs to another scenario.
        """
        if snapshot.scenario != scenario_to_dict(self.scenario):
            raise SimulationError(
                f"the snapshot belongs to scenario {snapshot.scenario}, not to {scenario_to_dict(self.scenario)}; "
                "make the simulation from it with Simulation.from_snapshot(snapshot)"
            )
        present = {key: getattr(self, key) for key in _CHANGING}
        for key, value in restored(present, snapshot.state, snapshot.arrays).items():
            setattr(self, key, value)
        self.samples = snapshot.samples
        self._logs, self._targets = list(snapshot.log), []

    @staticmethod
    def from_snapshot(snapshot: Snapshot) -> Simulation:
        """Create the simulation of a snapshot, at its time."""
        simulation = Simulation(Scenario(**snapshot.scenario))
        simulation.restore(snapshot)
        return simulation

    def branch(self, seed: np.random.SeedSequence) -> None:
        """Draw new random values for operator and soil.

        The operator's present action continues, see `redraw`.
        """
        hand, course = seed.spawn(2)
        # In place: all streams of the operator share this generator.
        self._hand.bit_generator.state = np.random.default_rng(hand).bit_generator.state
        # Targets drawn before the branch and not yet used belong to the old future.
        self.operator.redraw(len(self._waiting))
        self._waiting = self._waiting[:0]
        self.branch_soil(course)

    def branch_soil(self, seed: np.random.SeedSequence) -> None:
        """Redraw the resistance of soil not yet reached; commands stay the same."""
        if self.plant.ground is not None:
            self.plant.ground.redraw(np.random.default_rng(seed))


_CHANGING = ("plant", "operator", "_hand", "_waiting")


def simulate(scenario: Scenario, progress: Callable[[float], None] | None = None) -> Recording:
    """Simulate one scenario.

    Args:
        scenario: scenario to simulate.
        progress: callback with the completed fraction, 0 to 1.

    Returns:
        The 24 channels of Table A.1 as sensors show them, then `EXTRA_CHANNELS` without noise; float32, SI units.

    Raises:
        SimulationError: the state became non-finite.
    """
    simulation = Simulation(scenario)
    simulation.run(scenario.samples, progress)
    return simulation.recording()


def _recording(scenario: Scenario, machine: Machine, log: Array, clamps: int) -> Recording:
    rate_hz, _, _, noise, _, chance = scenario.rate_hz, *seeds_of(scenario)
    rng = np.random.default_rng(noise) if scenario.sensor_noise else None
    faults = SensorCourse(scenario.faults)
    drawn = faults.drawn(draws.draw(machine, len(log), rate_hz, rng), rate_hz, np.random.default_rng(chance))
    kelvin = log[:, at.LOG_OIL] + 273.15
    measured = sensors.observe_signals(log, machine, rate_hz, rng is not None, drawn, kelvin, faults.table)
    truth = sensors.truth_signals(log)
    # Strokes, pump pressures and oil temperature as they are shown: only a fault makes them differ from the truth.
    truth |= {name: measured[:, column] for name, column in sensors.shown_names().items()}
    further = {**EXTRA_CHANNELS, **GROUND_CHANNELS, **MOTOR_CHANNELS}
    extra = {name: channel for name, channel in further.items() if name in truth}
    facts = {key: value for key, value in scenario_to_dict(scenario).items() if key != "name"}
    mass = look_up_mass(scenario.machine)
    if mass is not None:
        facts["mass_t"] = round(mass, 3)
    shares = shares_at(scenario.faults, np.arange(len(log)), rate_hz)
    for name, share in zip(FAULT_CHANNELS, shares.T, strict=False):
        extra[name], truth[name] = FAULT_CHANNELS[name], share
    values = np.empty((len(log), len(TABLE_A1) + len(extra)), np.float32)
    values[:, : len(TABLE_A1)] = measured[:, : len(TABLE_A1)]
    for n, name in enumerate(extra, start=len(TABLE_A1)):
        values[:, n] = truth[name]
    return Recording(
        name=scenario.label,
        channels=(*TABLE_A1.values(), *extra.values()),
        values=values,
        rate_hz=scenario.rate_hz,
        source=f"sim:{machine.name}",
        meta={**facts, "clamps": clamps, "full_strokes_m": list(machine.cylinders.stroke)},
    )
