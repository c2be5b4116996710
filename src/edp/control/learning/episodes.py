"""Batched episodes of a task, the common part of single and vectorised environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.base import Controller
from edp.control.geometry import AXES
from edp.control.learning.features import MOST, ReferenceRows, TaskFeatures, remembered
from edp.control.learning.lanes import plant_lanes, single_plant
from edp.control.learning.spec import LearningSpec
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.plant import PlantInterface
from edp.control.tasks import ControlTask, draw_task
from edp.control.valve_map import RUN_S, measure_valve_map
from edp.errors import ConfigError
from edp.sim.environment.library import gymnasium

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
DRAWS = 20
"""Seeds that are tried where none is asked for: some have no reference that the machine can do."""


class TaskEpisodes:
    """Lanes of one task, each with its own reference, plant and base controller.

    Args:
        spec: of the task.
        count: of lanes.

    Attributes:
        plant: as a controller sees it.
        features: what is observed.
        position_m: distance of each tip to its reference now, shape (lanes,).
        tick: of each lane, shape (lanes,).

    Raises:
        EdpError: settings or plant cannot be used.
    """

    def __init__(self, spec: LearningSpec, count: int) -> None:
        self.spec, self.count = spec, count
        self._task, self._lanes = spec.task_spec, plant_lanes(spec, count)
        self.plant, self._limits = self._lanes.interface, self._task.limits
        self.features = TaskFeatures(spec, self.plant)
        self._reads = self.plant.columns(self.features.reads)
        self._pressures = np.array(
            [n for n, channel in enumerate(self.plant.channels) if channel.name.startswith("CylPressures_")],
            dtype=np.int64,
        )
        self._rows = ReferenceRows(count, spec.ticks, self.features.preview)
        self._bases = _bases(spec, self.plant, self._limits, count)
        self._past = np.zeros((count, self.features.depth, AXES))
        self._base = np.zeros((count, AXES))
        self.tick, self._ends = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        self.position_m, self._largest = np.zeros(count), np.zeros(count)
        # Judged ticks, squared position and attitude errors, lever travel, violations.
        self._sums = np.zeros((count, 5))

    @property
    def spaces(self) -> tuple[Any, Any]:
        """Return the spaces of observation and action."""
        observations = gymnasium.spaces.Box(-MOST, MOST, (len(self.features.names),), np.float32)
        return observations, gymnasium.spaces.Box(-1.0, 1.0, (AXES,), np.float32)

    def begin(self, lane: int, seed: int | None, rng: np.random.Generator) -> dict[str, object]:
        """Begin an episode of one environment and return its description.

        Args:
            lane: which.
            seed: of reference and sensors; None draws one.
            rng: draws it.

        Raises:
            ConfigError: no reference of this seed, or of `DRAWS` drawn ones, can be done.
        """
        task = self._draw_feasible_task(seed, rng)
        reference = task.reference
        shares = np.clip(reference.strokes[0] / self.plant.geometry.full_m, 0.0, 1.0)
        self._lanes.begin(lane, task.seed, tuple(map(float, shares)), task.material)
        self._rows.put(lane, reference)
        actions = (min(reference.ticks, self.spec.ticks) - 1) // self.spec.hold
        self.tick[lane], self._ends[lane] = 0, actions * self.spec.hold
        self._past[lane], self._sums[lane], self._largest[lane] = 0.0, 0.0, 0.0
        self._measure()
        if self._bases:
            observed = self._lanes.observed[lane].astype(float)
            self._bases[lane].reset(observed, reference)
            self._base[lane] = self._bases[lane].step(observed, 0)
        return {"seed": task.seed, "seconds": float(self._ends[lane] / self.plant.rate_hz)}

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

    def act(self, actions: Array, going: Bools) -> tuple[Array, Bools, Bools]:
        """Hold actions, shape (lanes, 3), for `hold` samples.

        Lanes that are not `going` are moved along and not judged: they are reset afterwards.

        Returns:
            Mean reward of the ticks, whether each lane lost its tip, and whether its reference ended.
        """
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
        return total / self.spec.hold - self.spec.reward.lost * lost, lost, truncated

    def _tick_of(self, actions: Array, going: Bools) -> Array:
        asked = self._base + self.spec.authority * actions if self._bases else actions
        before = self._past[:, 0]
        applied = self._limits.applied(asked, before, self.plant.rate_hz)
        # What the plant is told is single precision, as in `run_loop`.
        self._lanes.step(applied.astype(np.float32))
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
        return np.where(going, self.spec.reward.of_tick(position, attitude, travel, violated), 0.0)

    def _measure(self) -> Array:
        """Measure the position errors; return the attitude errors (rad), shape (lanes,)."""
        apart = self._rows.tip(self.tick) - self._lanes.tip
        self.position_m = np.hypot(apart[:, 0], apart[:, 1])
        return np.arctan2(np.sin(apart[:, 2]), np.cos(apart[:, 2]))

    def _check_limits(self) -> Bools:
        shares = self._lanes.strokes / self.plant.geometry.full_m
        margin = self._limits.stroke_margin
        ends = ((shares < margin) | (shares > 1.0 - margin)).any(axis=1)
        return np.asarray(ends | (self._lanes.observed[:, self._pressures] > self._limits.pressure_pa).any(axis=1))

    def _ask_bases(self, going: Bools) -> None:
        for lane in np.flatnonzero(going).tolist():
            observed = self._lanes.observed[lane].astype(float)
            self._base[lane] = self._bases[lane].step(observed, int(self.tick[lane]))

    def observation(self) -> NDArray[np.float32]:
        """Return the observations, shape (lanes, value)."""
        measured = self._lanes.observed[:, self._reads].astype(float)
        return self.features.values(measured, self._rows.now(self.tick), self._past, self._base)

    def score(self, lane: int) -> Mapping[str, float]:
        """Return the metrics of an episode over its evaluated samples so far."""
        ticks, squared, attitude, travel, violations = self._sums[lane].tolist()
        count = max(ticks, 1.0)
        return {
            "position_rms_mm": 1e3 * float(np.sqrt(squared / count)),
            "position_max_mm": 1e3 * float(self._largest[lane]),
            "attitude_rms_deg": float(np.degrees(np.sqrt(attitude / count))),
            "lever_travel": travel,
            "violations": violations,
        }


def _bases(spec: LearningSpec, plant: PlantInterface, limits: LoopLimits, count: int) -> list[Controller]:
    """Return a base controller per environment; empty if actions are the levers."""
    controller = spec.controller
    if controller is None:
        return []
    models = base_models(spec, plant)
    return [controller.build(plant, limits, models) for _ in range(count)]


def base_models(spec: LearningSpec, plant: PlantInterface) -> ControlModels:
    """Return the models of a base controller: a valve map measured on the plant as in `edp control`."""
    return ControlModels(measure_valve_map(single_plant(spec, RUN_S + 1.0), plant))
