"""Batched plants: the simulator in one compiled call, a twin as a batch, or any environments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.learning.spec import LearningSpec
from edp.control.plant import STROKES, PlantInterface, interface_of
from edp.control.plants import is_fmu, of_rate, plant_of, twin_of
from edp.control.twin_environment import TIP, TwinEnvironment, TwinStart, check_air
from edp.errors import ConfigError
from edp.networks.twin import Twin, TwinState
from edp.sim.environment import ExcavatorEnv, VectorExcavatorEnv
from edp.sim.machine.machine_files import load_machine
from edp.storage.reading import Table

Array = NDArray[np.float64]


class PlantLanes(ABC):
    """Machines side by side that begin apart and step together.

    Attributes:
        interface: of each of them, as a controller sees it.
        observed: what is measured now, shape (lanes, channel).
        strokes: true strokes now, m, shape (lanes, 3).
        tip: true tip now: x, y (m) and attitude (rad), shape (lanes, 3).
    """

    interface: PlantInterface
    observed: NDArray[np.float32]
    strokes: Array
    tip: Array

    @abstractmethod
    def begin(self, lane: int, seed: int, shares: Sequence[float], material: str) -> None:
        """Set one machine to a steady state at the given strokes (fractions of full stroke).

        Raises:
            ConfigError: it cannot begin there.
        """

    @abstractmethod
    def step(self, levers: NDArray[np.float32]) -> None:
        """Hold levers, shape (lanes, 3), for one sample."""


class SimulatorLanes(PlantLanes):
    """The simulator: one compiled call a tick.

    Args:
        spec: of the task.
        count: of lanes.
    """

    def __init__(self, spec: LearningSpec, count: int) -> None:
        # Episodes of the plant never end by themselves: the task's do, and each lane is reset by it.
        self._env, self._count = VectorExcavatorEnv(count, spec.plant_settings, autoreset_mode="Disabled"), count
        self.interface = interface_of(single_plant(spec, 1.0))
        self.observed = np.zeros((count, len(self.interface.channels)), np.float32)
        # A step moves all lanes, so that all must have begun.
        self._show(*self._env.reset(seed=0))

    def begin(self, lane: int, seed: int, shares: Sequence[float], material: str) -> None:
        """See `PlantLanes`."""
        mask = np.arange(self._count) == lane
        options = {"reset_mask": mask, "strokes": tuple(shares), "material": material}
        self._show(*self._env.reset(seed=[seed if chosen else None for chosen in mask], options=options))

    def step(self, levers: NDArray[np.float32]) -> None:
        """See `PlantLanes`."""
        observed, _, _, _, infos = self._env.step(levers)
        self._show(observed, infos)

    def _show(self, observed: NDArray[np.float32], infos: Table) -> None:
        self.observed = observed
        self.strokes, self.tip = (
            np.stack([infos["truth"][name] for name in names], axis=1) for names in (STROKES, TIP)
        )


class TwinLanes(PlantLanes):
    """Batch of a twin.

    Args:
        twin: the plant.
        machine: name or file of its machine.
        count: of lanes.

    Raises:
        ConfigError: it is no twin of an excavator with strokes.
    """

    def __init__(self, twin: Twin, machine: str, count: int) -> None:
        self._twin, self._start = twin, TwinStart(twin, machine)
        self.interface = interface_of(TwinEnvironment(twin, machine, 1.0))
        state, row = self._start.begin((0.5,) * AXES)
        self._state: TwinState = {name: np.repeat(values, count, axis=0) for name, values in state.items()}
        self._show(np.repeat(row[None], count, axis=0))

    def begin(self, lane: int, seed: int, shares: Sequence[float], material: str) -> None:
        """Begin as in `PlantLanes`; a twin uses no random numbers."""
        check_air(material)
        state, row = self._start.begin(shares)
        self._state = {name: values.copy() for name, values in self._state.items()}
        for name, values in state.items():
            self._state[name][lane] = values[0]
        rows = self.observed.copy()
        rows[lane] = row
        self._show(rows)

    def step(self, levers: NDArray[np.float32]) -> None:
        """See `PlantLanes`."""
        pilots = self._start.pilots(np.asarray(levers, float))
        answers, self._state = self._twin.step(pilots, self._state)
        self._show(np.concatenate([answers, pilots], axis=1).astype(np.float32))

    def _show(self, rows: NDArray[np.float32]) -> None:
        self.observed, self.strokes = rows, rows[:, self._start.strokes].astype(float)
        self.tip = self.interface.geometry.tip(self.strokes)


class EnvironmentLanes(PlantLanes):
    """Environments with the interface of a plant, one after another.

    Args:
        new: makes one.
        count: of lanes.
    """

    def __init__(self, new: Callable[[], Any], count: int) -> None:
        self._envs = [new() for _ in range(count)]
        self.interface = interface_of(self._envs[0])
        self.observed = np.zeros((count, len(self.interface.channels)), np.float32)
        self.strokes, self.tip = np.zeros((count, AXES)), np.zeros((count, AXES))
        self._begun = [False] * count

    def begin(self, lane: int, seed: int, shares: Sequence[float], material: str) -> None:
        """See `PlantLanes`."""
        options = {"strokes": tuple(shares), "material": material}
        self._show(lane, *self._envs[lane].reset(seed=seed, options=options))
        self._begun[lane] = True

    def step(self, levers: NDArray[np.float32]) -> None:
        """See `PlantLanes`."""
        for lane, env in enumerate(self._envs):
            if self._begun[lane]:
                observed, _, _, _, info = env.step(levers[lane])
                self._show(lane, observed, info)

    def _show(self, lane: int, observed: NDArray[np.float32], info: Table) -> None:
        self.observed[lane] = observed
        self.strokes[lane] = [info["truth"][name] for name in STROKES]
        self.tip[lane] = [info["truth"][name] for name in TIP]


def plant_lanes(spec: LearningSpec, count: int) -> PlantLanes:
    """Create the plants of a task: the simulator, a twin or an FMU.

    Raises:
        EdpError: the plant cannot be read or run, or has another rate.
    """
    if spec.plant is None:
        return SimulatorLanes(spec, count)
    if spec.simulator:
        raise ConfigError(
            f"task environment: {sorted(spec.simulator)} are settings of the simulator, and another plant is set; "
            "leave one out"
        )
    if not isinstance(spec.plant, Twin) and is_fmu(spec.plant):
        return EnvironmentLanes(lambda: single_plant(spec, spec.plant_settings.duration_s), count)
    return TwinLanes(_twin(spec), spec.machine, count)


def single_plant(spec: LearningSpec, duration_s: float) -> Any:
    """Create the plant of a task as a single environment, for episodes of at most `duration_s`.

    Raises:
        EdpError: the plant cannot be read or run, or has another rate.
    """
    if spec.plant is None:
        return ExcavatorEnv(replace(spec.plant_settings, duration_s=duration_s))
    if isinstance(spec.plant, Twin):
        return TwinEnvironment(_twin(spec), spec.machine, duration_s)
    return plant_of(spec.machine, duration_s, spec.rate_hz, spec.plant, trusted=spec.trust_fmu)


def _twin(spec: LearningSpec) -> Twin:
    """Return the twin of a task.

    Raises:
        EdpError: it cannot be read, or has another rate.
    """
    if isinstance(spec.plant, Twin):
        return of_rate(spec.plant, "the twin", spec.rate_hz)
    return twin_of(str(spec.plant), load_machine(spec.machine), spec.rate_hz)
