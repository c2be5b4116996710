"""Predictability limit: lowest possible prediction error, estimated by branching simulations.

At each branching time the simulation is stored. It then continues many times with new random values for the operator
(the current action continues with a new duration and new following actions), for soil not yet reached and for the
sensors. For a known state and known equations, the best prediction of a later measured velocity is its median over
these futures, because the median has the lowest mean absolute error; this error is the limit. With known future
commands only soil and sensors differ between the branches, which gives the limit of a predictor that knows the
commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import WorkUnit
from edp.progress import SILENT, Progress
from edp.settings.bounds import MAX_HORIZONS, MAX_NAMES, SEED, check_bounds, check_count, integer, shown
from edp.signals import TABLE_A1
from edp.sim.limit_file import LimitErrors, LimitFile, Rows
from edp.sim.machine import layout as at
from edp.sim.plan import machine_hash, scenario_of_unit
from edp.sim.scenario import Scenario, scenario_to_dict
from edp.sim.sensors import sensors
from edp.sim.simulate import Simulation
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.reading import Table

Array = NDArray[np.float64]
TARGETS = tuple(TABLE_A1)[:3]
PAST = 40
"""Number of samples before a branch that the sensors process. It exceeds every bus latency."""
RESAMPLES = 2000
"""Number of bootstrap samples of the recordings."""
CONFIDENCE = 0.95
MAX_BRANCHES, MAX_MOMENTS = 4096, 100_000
"""Maximum number of branches and of branching times. The usual 32 branches at 240 times take minutes."""
MOST_AHEAD = 2000
"""Maximum horizon in samples, 20 s at 100 Hz."""
KINDS = ("commands_unknown", "commands_known", "persistence")


@dataclass(frozen=True)
class LimitSpec:
    """Settings for estimating the limit.

    Attributes:
        horizons: samples ahead, rising.
        moments: number of branching points, spread over the recordings.
        branches: futures from each; even.
        recordings: maximum number of recordings to use.
        seed: root of the choice of moments and of all branches.

    Raises:
        ConfigError: a number is out of range.
    """

    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    moments: int = 240
    branches: int = 32
    recordings: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("limit", "horizons", self.horizons, MAX_HORIZONS, least=1)
        check_bounds(
            "limit",
            self,
            horizons=integer(1, MOST_AHEAD),
            moments=integer(2, MAX_MOMENTS),
            branches=integer(4, MAX_BRANCHES),
            recordings=integer(1, MAX_NAMES),
            seed=SEED,
        )
        if any(a >= b for a, b in pairwise(self.horizons)):
            raise ConfigError(f"limit: horizons = {shown(self.horizons)} must rise")
        if self.branches % 2:
            raise ConfigError(f"limit: branches = {self.branches} must be even")


@dataclass(frozen=True)
class LimitJob:
    """The moments of one recording."""

    scenario: Scenario
    moments: tuple[int, ...]
    spec: LimitSpec
    seed: int

    @property
    def label(self) -> str:
        """Name of the recording."""
        return self.scenario.label


def least_mae(values: Array) -> Array:
    """Return the least mean absolute error of any guess of values like these, shape (branch, ...), over the branches.

    The mean distance from the samples' own median is too small, because the median was fitted to them; the mean
    distance of each sample from the median of the others is too large, because that median is not the best guess. To
    first order both miss by the same, 1 / (4 N f) with f the density at the median, so their mean is taken. For an
    even number of sorted values it is the former plus a quarter of the gap in the middle.
    """
    ordered_values = np.sort(values, axis=0)
    half = len(values) // 2
    own = (ordered_values[half:].sum(axis=0) - ordered_values[:half].sum(axis=0)) / len(values)
    least: Array = own + 0.25 * (ordered_values[half] - ordered_values[half - 1])
    return least


def branch_recording(job: LimitJob) -> Array:
    """Return errors at each moment of one recording, shape (moment, kind, horizon, target), m/s; kinds are `KINDS`."""
    simulation, spec = Simulation(job.scenario), job.spec
    root = np.random.SeedSequence(job.seed)
    errors = np.empty((len(job.moments), len(KINDS), len(spec.horizons), len(TARGETS)))
    for n, (moment, seed) in enumerate(zip(job.moments, root.spawn(len(job.moments)), strict=True)):
        # Moments rise, so the recording is simulated once, however many moments it has.
        simulation.run(moment - simulation.samples)
        snapshot = simulation.snapshot()
        past = simulation.log[-PAST:]
        known_futures = _futures(simulation, past, spec, seed.spawn(2)[0], commands_known=True)
        simulation.restore(snapshot)
        # A seed sequence counts on: these two children differ from those of the call above.
        unknown = _futures(simulation, past, spec, seed.spawn(2)[1], commands_known=False)
        simulation.restore(snapshot)
        errors[n, 0], errors[n, 1] = least_mae(unknown[:, 1:]), least_mae(known_futures[:, 1:])
        errors[n, 2] = np.abs(unknown[:, 1:] - unknown[:, :1]).mean(axis=0)
    return errors


def _futures(
    simulation: Simulation, past: Array, spec: LimitSpec, seed: np.random.SeedSequence, commands_known: bool
) -> Array:
    """Return measured velocities now and at the horizons in each future, shape (branch, 1 + horizon, target), m/s."""
    snapshot = simulation.snapshot()
    length = spec.horizons[-1] + 1
    rows = simulation.run(length)
    commands = simulation.targets[-length:]
    at_times = len(past) + np.array([0, *spec.horizons])
    futures = np.empty((spec.branches, len(at_times), len(TARGETS)))
    for b, branch in enumerate(seed.spawn(spec.branches)):
        branch_seed, noise = branch.spawn(2)
        # With known commands and without soil there is one future; only the sensors differ.
        if not commands_known or simulation.plant.ground is not None:
            simulation.restore(snapshot)
            if commands_known:
                simulation.branch_soil(branch_seed)
                rows = simulation.follow(commands)
            else:
                simulation.branch(branch_seed)
                rows = simulation.run(length)
        futures[b] = _measure_outputs(simulation, np.concatenate((past, rows)), noise)[at_times]
    return futures


def _measure_outputs(simulation: Simulation, log: Array, seed: np.random.SeedSequence) -> Array:
    scenario = simulation.scenario
    rng = np.random.default_rng(seed) if scenario.sensor_noise else None
    signals = sensors.measure_signals(log, simulation.machine, scenario.rate_hz, rng, log[:, at.LOG_OIL] + 273.15)
    return signals[:, : len(TARGETS)]


def plan_limit(scenarios: Sequence[Scenario], spec: LimitSpec) -> list[LimitJob]:
    """Return the samples of the recordings from which branches start.

    Raises:
        ConfigError: the recordings are too short for the horizons, or have faults.
    """
    faulty = next((scenario for scenario in scenarios if scenario.faults), None)
    if faulty is not None:
        raise ConfigError(
            f"limit: '{faulty.label}' has faults, and the limit is that of a sound machine; leave out faults or limit"
        )
    # Stream 1 chooses moments, stream 2 resamples: neither changes with the other.
    rng = np.random.default_rng([spec.seed, 1])
    count = min(len(scenarios), spec.recordings, spec.moments)
    chosen = sorted(rng.permutation(len(scenarios))[:count].tolist())
    jobs = []
    for job_index, index in enumerate(chosen):
        scenario = scenarios[index]
        # The farthest horizon must end within the recording.
        last = scenario.samples - spec.horizons[-1] - 1
        share = spec.moments // count + (1 if job_index < spec.moments % count else 0)
        if last < PAST + share:
            raise ConfigError(
                f"limit: '{scenario.label}' has {scenario.samples} samples, too few for {share} moments and a "
                f"horizon of {spec.horizons[-1]}; take longer recordings, fewer moments or shorter horizons"
            )
        moments = PAST + rng.choice(last - PAST, share, replace=False)
        jobs.append(LimitJob(scenario, tuple(sorted(moments.tolist())), spec, int(rng.integers(2**62))))
    return jobs


def find_limit(
    scenarios: Sequence[Scenario],
    spec: LimitSpec | None = None,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
    folder: Path | None = None,
) -> LimitFile:
    """Return the predictability limit of a data set in mm/s, equal for any number of workers.

    Args:
        scenarios: scenarios of the recordings.
        spec: moments, branches and horizons.
        workers: who simulates the branches.
        progress: receiver of the progress; its units are recordings.
        folder: folder for the errors of each recording, from which a stopped call continues; None to store nothing.

    Raises:
        ConfigError: the recordings are too short.
        SimulationError: a simulation diverged.
    """
    spec = spec or LimitSpec()
    jobs = plan_limit(scenarios, spec)
    parts = []
    for result in workers.map_in_order(list(map(_unit, jobs)), progress.stage("recording", len(jobs)), folder):
        part = unpack(result.content or b"", np.ndarray)
        # mm/s, as results are stated.
        parts.append(1e3 * np.concatenate((part, part.mean(axis=-1, keepdims=True)), axis=-1))
    low, high = _confidence(parts, np.random.default_rng([spec.seed, 2]))
    mean = np.concatenate(parts).mean(axis=0)
    commands_unknown, commands_known, persistence = (
        LimitErrors(mae=_rows(mean[n]), low=_rows(low[n]), high=_rows(high[n])) for n in range(len(KINDS))
    )
    return LimitFile(
        unit="mm/s",
        rate_hz=jobs[0].scenario.rate_hz,
        horizons=tuple(spec.horizons),
        targets=tuple(TARGETS),
        confidence=CONFIDENCE,
        moments=spec.moments,
        branches=spec.branches,
        recordings=len(jobs),
        seed=spec.seed,
        commands_unknown=commands_unknown,
        commands_known=commands_known,
        persistence=persistence,
    )


def _rows(table: Array) -> Rows:
    return tuple(tuple(row) for row in np.round(table, 5).tolist())


def _unit(job: LimitJob) -> WorkUnit:
    arguments = {
        "scenario": scenario_to_dict(job.scenario),
        "moments": list(job.moments),
        "spec": asdict(job.spec),
        "seed": job.seed,
    }
    return WorkUnit(f"{__name__}:branch_unit", f"'{job.label}'", arguments, machine_hash(job.scenario))


def branch_unit(identity: TrainingIdentity, where: Table) -> WithState:
    """Branch the moments of the recording of a unit."""
    config = identity.config
    scenario = scenario_of_unit(config["scenario"], identity.data)
    spec = LimitSpec(**(config["spec"] | {"horizons": tuple(config["spec"]["horizons"])}))
    return WithState({}, pack(branch_recording(LimitJob(scenario, tuple(config["moments"]), spec, config["seed"]))))


def _confidence(parts: Sequence[Array], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the percentile bounds of the mean by resampling recordings; moments, where there is one recording."""
    # Moments of one recording depend on one another, so whole recordings are drawn where there are several.
    units = parts if len(parts) > 1 else [moment[None] for moment in parts[0]]
    sums = np.stack([unit.sum(axis=0) for unit in units])
    counts = np.array([len(unit) for unit in units], dtype=float)
    drawn = rng.multinomial(len(units), np.full(len(units), 1.0 / len(units)), RESAMPLES).astype(float)
    means = np.einsum("ru,u...->r...", drawn, sums) / (drawn @ counts).reshape(-1, *[1] * (sums.ndim - 1))
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(means, [tail, 1.0 - tail], axis=0)
    return low, high
