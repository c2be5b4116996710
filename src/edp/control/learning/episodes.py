"""Batched episodes of a task on the simulator, a twin or an FMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edp.control.base import Controller
from edp.control.fmu.environment import FmuBatch
from edp.control.geometry import AXES
from edp.control.learning.features import MOST, ReferenceRows, TaskFeatures, remembered
from edp.control.learning.spec import LearningSpec
from edp.control.limits import LoopLimits
from edp.control.model_batch import TIP
from edp.control.models import ControlModels
from edp.control.plant import STROKES, PlantInterface, interface_of
from edp.control.plants import check_rate, check_trusted, is_fmu, twin_of
from edp.control.tasks import ControlTask, draw_task
from edp.control.twin_environment import TwinBatch
from edp.control.valve_map import RUN_S, measure_valve_map
from edp.errors import ConfigError
from edp.networks.twin import Twin
from edp.sim.environment.batch import ALL, EpisodeBatch, Index, Infos, Options, PlantBatch, StepOutcome, check_finite
from edp.sim.environment.library import gymnasium
from edp.sim.environment.simulator import SimulatorBatch
from edp.sim.environment.single import SingleEnvironment
from edp.sim.machine.machine_files import load_machine

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
DRAWS = 20
"""Seeds that are tried where none is asked for: some have no reference that the machine can do."""


class TaskEpisodes(EpisodeBatch):
    """Episodes of one task, each with its own reference, plant and base controller.

    Args:
        spec: settings of the task.
        count: number of episodes.

    Attributes:
        plant: interface of the plant for controllers.
        features: observed features.
        position_m: distance of each tip to its reference now, shape (count,).
        tick: current sample of each episode, shape (count,).

    Raises:
        EdpError: settings or plant cannot be used.
    """

    def __init__(self, spec: LearningSpec, count: int) -> None:
        self.spec, self.count = spec, count
        self._task, self._plants = spec.task_spec, plant_batch(spec, count, spec.plant_settings.duration_s)
        # Observations are finite before an episode begins, too.
        self._plants.observed[:] = 0.0
        self.plant, self._limits = interface_of(self._plants), self._task.limits
        self.rate_hz, self.features = self.plant.rate_hz, TaskFeatures(spec, self.plant)
        self.observation_space = gymnasium.spaces.Box(-MOST, MOST, (len(self.features.names),), np.float32)
        self._reads = self.plant.columns(self.features.reads)
        self._pressures = np.array(
            [n for n, channel in enumerate(self.plant.channels) if channel.name.startswith("CylPressures_")],
            dtype=np.int64,
        )
        self._rows = ReferenceRows(count, spec.ticks, self.features.preview)
        self._bases = _bases(spec, self.plant, self._limits, count)
        self._past = np.zeros((count, self.features.depth, AXES))
        self._base, self._strokes = np.zeros((count, AXES)), np.zeros((count, AXES))
        self.tick, self._ends = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        self.position_m, self._largest = np.zeros(count), np.zeros(count)
        # Judged ticks, squared position and attitude errors, lever travel, violations.
        self._sums = np.zeros((count, 5))

    def begin(self, index: int, seed: int | None, rng: np.random.Generator, options: Options) -> Infos:
        """Begin an episode with a seed for reference and sensors; options are refused.

        Raises:
            ConfigError: no reference of this seed, or of `DRAWS` drawn ones, can be done, or an option came.
        """
        if options:
            raise ConfigError(f"reset of a task: option '{next(iter(options))}' is unknown; there is none")
        task = self._draw_feasible_task(seed, rng)
        reference = task.reference
        shares = np.clip(reference.strokes[0] / self.plant.geometry.full_m, 0.0, 1.0)
        start = {"strokes": tuple(map(float, shares)), "material": task.material}
        self._plants.begin(index, task.seed, rng, start)
        self._rows.put(index, reference)
        actions = (min(reference.ticks, self.spec.ticks) - 1) // self.spec.hold
        self.tick[index], self._ends[index] = 0, actions * self.spec.hold
        self._past[index], self._sums[index], self._largest[index] = 0.0, 0.0, 0.0
        self._measure()
        if self._bases:
            observed = self._plants.observed[index].astype(float)
            self._bases[index].reset(observed, reference)
            self._base[index] = self._bases[index].step(observed, 0)
        return {"seed": task.seed, "seconds": float(self._ends[index] / self.plant.rate_hz)}

    def _draw_feasible_task(self, seed: int | None, rng: np.random.Generator) -> ControlTask:
        """Return the task for a seed, or a random feasible task; the last of `DRAWS` raises the reason."""
        low, high = self.spec.seeds
        for _ in range(DRAWS - 1 if seed is None else 0):
            try:
                return self._draw_task(int(rng.integers(low, high + 1)))
            except ConfigError:
                continue
        return self._draw_task(int(rng.integers(low, high + 1)) if seed is None else seed)

    def _draw_task(self, seed: int) -> ControlTask:
        return draw_task(self._task, self.plant.geometry, self.plant.rate_hz, seed)

    def step(self, actions: Array, active: Bools | None = None) -> StepOutcome:
        """Hold actions, shape (count, 3), for `hold` ticks.

        The rewards are the mean of the ticks. An episode terminates where its tip is lost, and is truncated at the end
        of its reference.

        Raises:
            ConfigError: an action is not finite.
            SimulationError: the state of a plant became non-finite.
        """
        check_finite(actions)
        going = np.ones(self.count, np.bool_) if active is None else active
        total = np.zeros(self.count)
        actions = np.clip(actions, -1.0, 1.0)
        for n in range(self.spec.hold):
            if n and self._bases:
                self._ask_bases(going)
            total += self._tick_of(actions, going)
        lost = going & (self.position_m > self.spec.lost_m)
        truncated = going & (self.tick >= self._ends) & ~lost
        if self._bases:
            self._ask_bases(going & ~lost & ~truncated)
        return StepOutcome(total / self.spec.hold - self.spec.reward.lost * lost, lost, truncated)

    def _tick_of(self, actions: Array, going: Bools) -> Array:
        asked = self._base + self.spec.authority * actions if self._bases else actions
        before = self._past[:, 0]
        applied = self._limits.applied(asked, before, self.plant.rate_hz)
        # What the plant is told is single precision, as in `run_loop`.
        self._plants.step(applied.astype(np.float32).astype(float), going)
        self._past = remembered(self._past, applied)
        self.tick = self.tick + going
        attitude = self._measure()
        travel = np.abs(applied - before).sum(axis=1)
        violated = self._check_limits()
        judged = going & self._rows.judged(self.tick)
        position = self.position_m
        parts = np.stack([np.ones(self.count), position**2, attitude**2, travel, violated], axis=1)
        self._sums += np.where(judged[:, None], parts, 0.0)
        self._largest = np.where(judged, np.maximum(self._largest, position), self._largest)
        return np.where(going, self.spec.reward.compute_reward(position, attitude, travel, violated), 0.0)

    def _measure(self) -> Array:
        """Measure the position errors; return the attitude errors (rad), shape (count,)."""
        truth = self._plants.truth(ALL)
        self._strokes, tip = (np.stack([np.asarray(truth[name]) for name in names], axis=1) for names in (STROKES, TIP))
        apart: Array = self._rows.tip(self.tick) - tip
        self.position_m = np.hypot(apart[:, 0], apart[:, 1])
        return np.arctan2(np.sin(apart[:, 2]), np.cos(apart[:, 2]))

    def _check_limits(self) -> Bools:
        shares = self._strokes / self.plant.geometry.full_m
        margin = self._limits.stroke_margin
        ends = ((shares < margin) | (shares > 1.0 - margin)).any(axis=1)
        return np.asarray(ends | (self._plants.observed[:, self._pressures] > self._limits.pressure_pa).any(axis=1))

    def _ask_bases(self, going: Bools) -> None:
        for index in np.flatnonzero(going).tolist():
            observed = self._plants.observed[index].astype(float)
            self._base[index] = self._bases[index].step(observed, int(self.tick[index]))

    def observation(self, index: Index) -> NDArray[np.float32]:
        """Return the observation of the policy, shape (value,) for one episode or (count, value) for all episodes."""
        measured = self._plants.observed[:, self._reads].astype(float)
        return self.features.values(measured, self._rows.now(self.tick), self._past, self._base)[index]

    def info(self, index: Index) -> Infos:
        """Return the position errors as ``position_m``."""
        position = self.position_m[index]
        return {"position_m": position.copy() if isinstance(index, slice) else float(position)}

    def summary(self, index: int) -> Infos:
        """Return the metrics of an episode over its evaluated samples until now, as ``score``."""
        ticks, squared, attitude, travel, violations = self._sums[index].tolist()
        count = max(ticks, 1.0)
        score = {
            "position_rms_mm": 1e3 * float(np.sqrt(squared / count)),
            "position_max_mm": 1e3 * float(self._largest[index]),
            "attitude_rms_deg": float(np.degrees(np.sqrt(attitude / count))),
            "lever_travel": travel,
            "violations": violations,
        }
        return {"score": score}


def _bases(spec: LearningSpec, plant: PlantInterface, limits: LoopLimits, count: int) -> list[Controller]:
    """Return a base controller per environment; empty if actions are the levers."""
    controller = spec.controller
    if controller is None:
        return []
    models = base_models(spec, plant)
    return [controller.build(plant, limits, models) for _ in range(count)]


def base_models(spec: LearningSpec, plant: PlantInterface) -> ControlModels:
    """Return the models of a base controller: a valve map measured on the plant as in `edp loop run`."""
    return ControlModels(measure_valve_map(SingleEnvironment(plant_batch(spec, 1, RUN_S + 1.0)), plant))


def plant_batch(spec: LearningSpec, count: int, duration_s: float) -> PlantBatch:
    """Create the plants of a task, a simulator, a twin or an FMU, for episodes of at most `duration_s`.

    Raises:
        EdpError: the plant cannot be read or run, or has another rate.
    """
    if spec.plant is None:
        return SimulatorBatch([replace(spec.plant_settings, duration_s=duration_s)] * count)
    if spec.simulator:
        raise ConfigError(
            f"task environment: {sorted(spec.simulator)} are settings of the simulator, and another plant is set; "
            "leave one out"
        )
    if isinstance(spec.plant, Twin):
        twin = check_rate(spec.plant, "the twin", spec.rate_hz)
    elif is_fmu(spec.plant):
        check_trusted(spec.plant, spec.trust_fmu)
        return FmuBatch(spec.plant, spec.machine, duration_s, spec.rate_hz, count)
    else:
        twin = twin_of(str(spec.plant), load_machine(spec.machine), spec.rate_hz)
    return TwinBatch(twin, spec.machine, duration_s, count)
