"""A closed loop: a controller and a plant, tick by tick, with all that was measured, done and true."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.base import ControlEvent, Controller, log_event
from edp.control.geometry import AXES, TipGeometry
from edp.control.guard import TRUSTED, LoopGuard, verdict_of
from edp.control.plant import STROKES
from edp.control.score import LoopScore, LoopTrace, scored
from edp.control.tasks.base import ControlTask
from edp.errors import ConfigError
from edp.recording import Recording
from edp.signals import GROUND_CHANNELS, VOCABULARY, Channel, Kind
from edp.storage.reading import Table
from edp.wording import typed

Array = NDArray[np.float64]
TRUE = "_true"
"""Suffix of a channel name for the noise-free value."""
TIP = ("TipX", "TipY", "TipAngle")
PUMPS = ("PumpPressure_1", "PumpPressure_2", "PumpDisplacement_1", "PumpDisplacement_2")
OTHERS = ("Payload", "OilTemperature", "TipForceX", "TipForceY")
REFERENCE = tuple(
    [Channel(f"Reference_{name}", VOCABULARY[name].kind, f"reference of {name}") for name in (*STROKES, *TIP)]
)
LEVERS = tuple(Channel(f"Lever_{i + 1}", Kind.RATIO, f"{c} lever") for i, c in enumerate(("Boom", "Arm", "Bucket")))


@dataclass(frozen=True, eq=False)
class LoopResult:
    """A loop that was run.

    Attributes:
        recording: a row a tick: observations, true values under names that end in `TRUE`, heights of the ground where
            there is one, reference, levers.
        score: over the evaluated ticks.
        events: events logged by the controller.
        solve_s: time of each step of the controller, shape (ticks,), s.
        infos: figures that the controller gave, by name, shape (ticks,) each; NaN where it gave none.
        warnings: warnings of the guard, without samples at which nothing was wrong.
    """

    recording: Recording
    score: LoopScore
    events: tuple[ControlEvent, ...]
    solve_s: Array
    infos: Mapping[str, Array]
    warnings: tuple[ControlEvent, ...] = ()


@dataclass(frozen=True, eq=False)
class _Rows:
    """Collected samples, one row each."""

    observed: Array
    truth: Array
    levers: Array
    solve_s: Array


def run_loop(
    env: Any,
    controller: Controller,
    task: ControlTask,
    seed: int,
    options: Mapping[str, object] | None = None,
    guard: LoopGuard | None = None,
    deadline_s: float = 0.0,
) -> LoopResult:
    """Run a controller on a plant along a task.

    Args:
        env: a gymnasium environment as `edp.control.base.interface_of` reads it, whose ``info["truth"]`` is a mapping
            of noise-free values by channel.
        controller: controller, built for an environment with the same channels.
        task: reference and limits.
        seed: seed of the environment.
        options: further options of the environment's reset.
        guard: guard that states at each sample which channels the controller may read, and whether it must fall back.
        deadline_s: time of the clock after which an output of the controller counts as missing: levers go towards
            neutral in its place. 0: none. A loop with a deadline depends on what else the computer does.

    Raises:
        ConfigError: the environment and the controller do not fit, or a channel is missing at the start.
    """
    reference, geometry = task.reference, controller.plant.geometry
    observation, info = env.reset(seed=seed, options={**start_options(task, geometry), **(options or {})})
    if len(np.asarray(observation)) != len(controller.plant.channels):
        raise ConfigError(
            f"the plant observes {len(np.asarray(observation))} channels, the controller was made for "
            f"{len(controller.plant.channels)}; make it for this plant"
        )
    controller.reset(np.asarray(observation, float), reference)
    names = tuple(name for name in (*STROKES, *TIP, *PUMPS, *OTHERS, *GROUND_CHANNELS) if name in info["truth"])
    if guard is not None:
        guard.reset(controller.plant)
    watched = _Watched(controller, guard, deadline_s)
    rows, infos = _run_loop(env, watched, reference.ticks, names, (observation, info))
    trace = _trace(rows, names, geometry, controller)
    score = scored(trace, reference, task.limits, sum(event.ticks for event in controller.events))
    recording = _make_recording(rows, names, task, controller)
    return LoopResult(recording, score, tuple(controller.events), rows.solve_s, infos, tuple(watched.warnings))


class _Watched:
    """A controller and what guards it."""

    def __init__(self, controller: Controller, guard: LoopGuard | None, deadline_s: float) -> None:
        self.controller, self._guard, self._deadline_s = controller, guard, deadline_s
        self.warnings: list[ControlEvent] = []

    def step(self, observation: Array, tick: int) -> tuple[Array, float]:
        """Return the levers of a tick, and the time (s) that the controller took, without the guard's."""
        verdict = TRUSTED if self._guard is None else verdict_of(self._guard, self.controller.plant, observation)
        if verdict.untrusted or verdict.fall_back:
            log_event(self.warnings, tick, str(verdict))
        before = self.controller.before if self._deadline_s else None
        began = time.perf_counter()
        levers = self.controller.step(observation, tick, verdict)
        spent = time.perf_counter() - began
        if before is not None and spent > self._deadline_s:
            levers = self.controller.late(before, tick, f"no answer within {typed(1e3 * self._deadline_s)} ms")
        return levers, spent


def _run_loop(
    env: Any, watched: _Watched, ticks: int, names: tuple[str, ...], start: tuple[Any, Table]
) -> tuple[_Rows, dict[str, Array]]:
    """Run tick by tick from an observation and its info; ends early where the plant does."""
    (observation, info), controller = start, watched.controller
    observed, truth = np.zeros((ticks, len(controller.plant.channels))), np.zeros((ticks, len(names)))
    levers, solve_s = np.zeros((ticks, AXES)), np.zeros(ticks)
    infos: dict[str, Array] = {}
    end = ticks
    for tick in range(ticks):
        observed[tick] = observation
        truth[tick] = [info["truth"][name] for name in names]
        levers[tick], solve_s[tick] = watched.step(observed[tick], tick)
        for name, value in controller.info.items():
            infos.setdefault(name, np.full(ticks, np.nan))[tick] = value
        observation, _, terminated, truncated, info = env.step(levers[tick].astype(np.float32))
        if terminated or truncated:
            end = tick + 1
            break
    rows = _Rows(observed[:end], truth[:end], levers[:end], solve_s[:end])
    return rows, {name: values[:end] for name, values in infos.items()}


def start_options(task: ControlTask, geometry: TipGeometry) -> Table:
    """Return the options of the environment's reset that put the machine at the start of a task."""
    shares = np.clip(task.reference.strokes[0] / geometry.full_m, 0.0, 1.0)
    return {"strokes": tuple(map(float, shares)), "material": task.material}


def _trace(rows: _Rows, names: tuple[str, ...], geometry: TipGeometry, controller: Controller) -> LoopTrace:
    """Return the data for scoring: true values if the plant has them, otherwise from its outputs by kinematics."""
    truth = {name: rows.truth[:, n] for n, name in enumerate(names)}
    measured = {channel.name: rows.observed[:, n] for n, channel in enumerate(controller.plant.channels)}
    strokes = np.stack([truth[name] for name in STROKES], axis=1)
    tip = np.stack([truth[name] for name in TIP], axis=1) if TIP[0] in truth else geometry.tip(strokes)
    pressures = [values for name, values in measured.items() if name.startswith("CylPressures_")]
    power = None
    if all(name in truth for name in PUMPS):
        flow = geometry.machine.pumps.max_flow
        power = flow * sum(truth[PUMPS[n]] * truth[PUMPS[n + 2]] for n in range(2))
    stacked = np.stack(pressures, axis=1) if pressures else np.zeros((len(tip), 0))
    return LoopTrace(tip, strokes / geometry.full_m, rows.levers, stacked, None if power is None else np.asarray(power))


def _make_recording(rows: _Rows, names: tuple[str, ...], task: ControlTask, controller: Controller) -> Recording:
    reference, plant = task.reference, controller.plant
    # The ground has no sensor, so that its heights need no other name; side views look for them.
    true = tuple(
        VOCABULARY[name]
        if name in GROUND_CHANNELS
        else replace(VOCABULARY[name], name=f"{name}{TRUE}", description=f"{VOCABULARY[name].description} (true)")
        for name in names
    )
    ticks = len(rows.levers)
    columns = [rows.observed, rows.truth, reference.strokes[:ticks], reference.tip[:ticks], rows.levers]
    return Recording(
        f"{task.name}_{task.seed}",
        (*plant.channels, *true, *REFERENCE, *LEVERS),
        np.ascontiguousarray(np.concatenate(columns, axis=1), dtype=np.float32),
        reference.rate_hz,
        f"loop:{plant.source}",
        {"task": task.name, "seed": task.seed, "machine": plant.geometry.machine.name},
    )
