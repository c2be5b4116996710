"""The run of the monitor's benchmark: its plan, its sessions, and what a monitor makes of them.

Summaries are written down once; alarms follow as often as what lies behind them changes.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import PrintedProgress, finite
from edp.config.monitor import MonitorExperiment, load_monitor_experiment
from edp.errors import DataError
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.chain import BlockVerdict, ChainState, MonitorChain
from edp.monitor.fitting import fit_from_blocks
from edp.monitor.monitor import Monitor
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.monitor.residuals.base import ONE_BY_ONE, ResidualSource, SideBySide
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.session_blocks import SessionBlocks, blocks_of
from edp.recording import Recording
from edp.storage import make_folder, read_json, write_bytes, write_json
from edp.workflows.monitor import fit_to_recordings
from edp.workflows.monitor.dictionary import build_dictionary, machine_of
from monitor_sessions import COUNTS, NUISANCES, plans_of, read_session, session_names, session_plans, write_sessions

Floats = NDArray[np.float64]
NEVER_H = 1e9
"""In place of infinity, which JSON lacks."""


@dataclass(frozen=True)
class Plan:
    """What one run does.

    Attributes:
        data: folder of sessions.
        monitor: folder of the monitor.
        hours: to a false alarm, promised.
        minutes: processor time of the monitor's networks.
        sessions: healthy ones that are fitted to.
        workers: processes.
        quick: short form.
        settings: of the monitor.
        fits: of the promise.
        until: wall time of the whole run at which nothing further is begun, s.
    """

    data: Path
    monitor: Path
    hours: float
    minutes: float
    sessions: int
    workers: int
    quick: bool
    settings: tuple[str, ...]
    fits: int = 20
    until: float = 1e9

    @property
    def experiment(self) -> MonitorExperiment:
        """Settings of the monitor."""
        options = {"hours_per_false_alarm": self.hours, "minutes": self.minutes}
        return load_monitor_experiment(None, self.settings, options)

    @property
    def named(self) -> Path:
        """Folder of the monitor with its dictionary."""
        return self.monitor / "named"

    @property
    def without_flow(self) -> Path:
        """Folder of the monitor without balances of flow."""
        return self.monitor / "without_flow"

    @property
    def fit_hours(self) -> float:
        """Hours to a false alarm that fits of the promise are asked for; they have few sessions in the short form."""
        return self.hours / 4 if self.quick else self.hours


@dataclass(frozen=True)
class _Job:
    folder: Path
    name: str
    monitor: Path
    cache: Path
    label: str


class ChainOfBlocks(MonitorChain):
    """A chain that takes summaries and operating points in place of residuals and raw rows."""

    def conditioned(self, residuals: Floats, rows: Floats, state: ChainState) -> tuple[Floats, Floats, ChainState]:
        """See `MonitorChain.conditioned`; whole sessions only."""
        gross = self.conditioning.unclipped(residuals, rows)
        gross[: self.settle] = np.nan
        z, drift = self.drift.run(np.clip(gross, -self.conditioning.clip, self.conditioning.clip), state.drift)
        return z, gross, replace(state, drift=drift, blocks=len(z))


class MonitorOfBlocks(Monitor):
    """A monitor that watches summaries of sessions.

    The networks of a session run once; what comes behind them is judged anew as often as it changes. `same_alarms`
    holds this way to `Monitor.run`.
    """

    def verdicts(self, recording: Any) -> Iterator[BlockVerdict]:
        """See `Monitor.verdicts`, of `SessionBlocks`."""
        yield from self.chain.run(recording.summaries, recording.points, self.chain.initial_state())[0]

    @staticmethod
    def from_chain(monitor: Monitor, chain: MonitorChain | None = None) -> MonitorOfBlocks:
        """Of a monitor, with another chain where one is given."""
        source = monitor.chain if chain is None else chain
        own = ChainOfBlocks(**{field.name: getattr(source, field.name) for field in fields(MonitorChain)})
        values = {field.name: getattr(monitor, field.name) for field in fields(Monitor)}
        return MonitorOfBlocks(**values | {"chain": own})


@lru_cache(maxsize=3)
def monitor_of(folder: Path) -> Monitor:
    return load_monitor(folder)


def refused(monitor: Monitor, recording: Recording) -> bool:
    """Whether the monitor takes a session for one of another machine; a user gets that error in place of alarms."""
    try:
        monitor.check(recording)
    except DataError:
        return True
    return False


def _summarise(job: _Job) -> str:
    monitor, recording = monitor_of(job.monitor), read_session(job.folder, job.name).recording
    part = blocks_of(monitor.chain.summaries, monitor.sources, monitor.channels, recording)
    write_blocks(job.cache, part, refused(monitor, recording))
    return job.name


def write_blocks(path: Path, part: SessionBlocks, refused: bool) -> None:
    """Write the summaries of a session down."""
    buffer = BytesIO()
    np.savez(buffer, summaries=part.summaries, points=part.points, refused=refused)
    write_bytes(path, buffer.getvalue())


def blocks_file(plan: Plan, part: str, name: str) -> Path:
    """Where the summaries of a session lie."""
    return plan.monitor / "blocks" / part / f"{name}.npz"


def read_blocks(path: Path) -> tuple[SessionBlocks, bool]:
    """Summaries of a session, and whether the monitor refuses it."""
    with np.load(path, allow_pickle=False) as arrays:
        return SessionBlocks(path.stem, arrays["summaries"], arrays["points"]), bool(arrays["refused"])


def summarise(plan: Plan, names: Sequence[str], side_by_side: SideBySide) -> None:
    """Write down the summaries of test sessions; those of an earlier run of the same monitor stay."""
    cache = make_folder(plan.monitor / "blocks" / "test")
    jobs = [
        _Job(plan.data / "test", name, plan.monitor, cache / f"{name}.npz", name)
        for name in names
        if not (cache / f"{name}.npz").exists()
    ]
    for number, name in enumerate(side_by_side(_summarise, jobs), start=1):
        if number % 50 == 0:
            print(f"test: {number} of {len(jobs)} summarised, {name}", flush=True)


@dataclass(frozen=True)
class _WatchJob:
    monitor: Path
    blocks: Path
    columns: tuple[int, ...]
    label: str


def _watch(job: _WatchJob) -> list[MonitorAlarm]:
    part, refused = read_blocks(job.blocks)
    if refused:
        print(f"{job.label}: refused as a session of another machine", flush=True)
        return []
    if job.columns:
        part = replace(part, summaries=part.summaries[:, job.columns])
    return list(MonitorOfBlocks.from_chain(monitor_of(job.monitor)).run(part))  # type: ignore[arg-type]


def watched(
    plan: Plan,
    names: Sequence[str],
    side_by_side: SideBySide = ONE_BY_ONE,
    monitor: Path | None = None,
    columns: Sequence[int] = (),
) -> dict[str, list[MonitorAlarm]]:
    """Alarms of test sessions by name; none where the monitor refuses a session as that of another machine.

    Args:
        plan: of the run.
        names: of sessions whose summaries are written down.
        side_by_side: calls a function for each of some jobs.
        monitor: folder of another monitor than that of the plan.
        columns: of the summaries that it has; all by default.
    """
    folder = plan.monitor if monitor is None else monitor
    jobs = [_WatchJob(folder, blocks_file(plan, "test", name), tuple(columns), name) for name in names]
    return dict(zip(names, side_by_side(_watch, jobs), strict=True))


def same_alarms(plan: Plan, found: dict[str, list[MonitorAlarm]], count: int = 6) -> tuple[int, int]:
    """Of how many sessions with alarms `Monitor.run` raises the same ones, and of how many; and seconds a session."""
    monitor = load_monitor(plan.monitor)
    names = [name for name, alarms in found.items() if alarms][:count]
    same = 0
    for name in names:
        direct = monitor.run(read_session(plan.data / "test", name).recording)
        same += [alarm.raised_s for alarm in direct] == [alarm.raised_s for alarm in found[name]]
    return same, len(names)


def fitted(plan: Plan, side_by_side: SideBySide = ONE_BY_ONE) -> dict[str, Any]:
    """Fit the monitor where it is not there yet, without its dictionary; what is kept of it."""
    facts = plan.monitor / "fit.json"
    if not facts.exists():
        names = session_names(plan.data / "training", "healthy")[: plan.sessions]
        experiment = plan.experiment
        experiment = replace(experiment, dictionary=replace(experiment.dictionary, machine="none"))
        recordings = [read_session(plan.data / "training", name).recording for name in names]
        result = fit_to_recordings(recordings, experiment, progress=PrintedProgress(), side_by_side=side_by_side)
        save_monitor(result.monitor, plan.monitor)
        make_folder(plan.monitor / "blocks" / "training")
        for part in result.sessions:
            write_blocks(blocks_file(plan, "training", part.name), part, refused=False)
        monitor = result.monitor
        write_json(
            facts,
            {
                "promise": monitor.limit.sentence(),
                "limit": asdict(monitor.limit) | {"high_hours": min(monitor.limit.high_hours, NEVER_H)},
                "residuals": list(monitor.residual_names),
                "provenance": {key: value for key, value in monitor.provenance.items() if key != "seconds"},
                "doubtful": list(result.doubtful),
            },
        )
    result_facts: dict[str, Any] = read_json(facts)
    return result_facts


def add_dictionary(plan: Plan, side_by_side: SideBySide = ONE_BY_ONE) -> bool:
    """Fit a monitor with a fault dictionary in a separate folder; return false without a machine to simulate."""
    if not (plan.named / "monitor.json").exists():
        monitor, spec = load_monitor(plan.monitor), plan.experiment.dictionary
        names = monitor.provenance["calibrated_on"]
        healthy = [read_session(plan.data / "training", name).recording for name in names]
        machine = machine_of(spec, healthy)
        if not machine:
            return False
        dictionary = build_dictionary(monitor, healthy, machine, spec, side_by_side=side_by_side)
        save_monitor(replace(monitor, diagnosis=dictionary), plan.named)
    return True


def columns_without_flow(monitor: Monitor) -> tuple[list[ResidualSource], list[int], list[int]]:
    """Return the sources without flow balances, their residual indices and their summary columns."""
    kept = [source for source in monitor.sources if not isinstance(source, FlowBalances)]
    own = {name for source in kept for name in source.names}
    residuals = [place for place, name in enumerate(monitor.residual_names) if name in own]
    each = monitor.chain.summaries.width // monitor.chain.summaries.residuals
    return kept, residuals, [place * each + number for place in residuals for number in range(each)]


def fit_without_flow(plan: Plan, side_by_side: SideBySide = ONE_BY_ONE) -> list[int]:
    """Refit the monitor without flow balances; return the columns of its summaries."""
    monitor = load_monitor(plan.monitor)
    kept, residuals, columns = columns_without_flow(monitor)
    if not (plan.without_flow / "monitor.json").exists():
        old = monitor.chain.summaries
        summaries = replace(
            old,
            scale=old.scale[residuals],
            channel=old.channel[residuals],
            change=old.change[residuals],
            drivers=old.drivers[:, residuals],
        )
        held = [read_blocks(blocks_file(plan, "training", name))[0] for name in monitor.provenance["calibrated_on"]]
        held = [replace(part, summaries=part.summaries[:, columns]) for part in held]
        result = fit_from_blocks(
            plan.experiment.chain, summaries, held, monitor.rate_hz, monitor.chain.settle, plan.hours,
            side_by_side=side_by_side,
        )  # fmt: skip
        save_monitor(
            replace(monitor, sources=tuple(kept), chain=result.chain, limit=result.limit, scatter=None),
            plan.without_flow,
        )
    return columns


def parts_of(plan: Plan) -> tuple[list[str], list[str]]:
    """Names of healthy training sessions: those that models are fitted to, and those that set limits."""
    names = session_names(plan.data / "training", "healthy")[: plan.sessions]
    limits = load_monitor(plan.monitor).provenance.get("calibrated_on")
    if not limits:
        limits = names[round(0.35 * len(names)) :]
    return [name for name in names if name not in set(limits)], list(limits)


BEGAN = time.monotonic()


def say(what: str, value: Any) -> None:
    """Print an intermediate result, for runs that are interrupted."""
    print(json.dumps({"found": what, "after_s": round(time.monotonic() - BEGAN), "value": finite(value)}), flush=True)


class Beside:
    """Work in a thread beside the rest, whose result is asked for later; ends with the program."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work, self._result = work, None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result = self._work()
        except Exception as error:
            self._error = error

    def done(self) -> bool:
        """Whether it has come to its end."""
        return not self._thread.is_alive()

    def result(self) -> Any:
        """Wait for the result and return it.

        Raises:
            Exception: that of the work.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._result


QUICK_COUNTS = {"training": (16, 0), "test": (6, 1)}
"""Healthy sessions, and those of each nuisance set."""


QUICK_SECONDS, QUICK_HOURS = 60.0, 0.1


QUICK_FAULTS = 12


def write_training(plan: Plan, side_by_side: SideBySide) -> None:
    """Simulate the sessions that are fitted to, where they are missing."""
    if plan.quick:
        healthy, _ = QUICK_COUNTS["training"]
        plans = plans_of("training", {"healthy": healthy, "faulty": 0, "nuisance": 0}, QUICK_SECONDS)
    else:
        plans = session_plans("training", "healthy", min(plan.sessions, COUNTS["training"]["healthy"]))
    write_sessions(plans, plan.data / "training", side_by_side)


def write_test(plan: Plan, side_by_side: SideBySide) -> None:
    """Simulate the sessions that are judged, where they are missing."""
    if not plan.quick:
        write_sessions(plans_of("test", COUNTS["test"]), plan.data / "test", side_by_side)
        return
    # With the seeds of the validation part: those of the test are for the full form alone.
    healthy, nuisance = QUICK_COUNTS["test"]
    plans = plans_of("validation", {"healthy": healthy, "faulty": 0, "nuisance": nuisance}, QUICK_SECONDS)
    faults = plans_of("validation", {"healthy": 0, "faulty": 1, "nuisance": 0}, QUICK_SECONDS)
    step = len(faults) // QUICK_FAULTS
    write_sessions([*plans, *faults[step - 1 :: step]], plan.data / "test", side_by_side)


def test_names(plan: Plan) -> dict[str, list[str]]:
    """Names of the test sessions by group; groups without any are left out."""
    groups = ("healthy", "faulty", *NUISANCES)
    if plan.quick:
        names = {group: session_names(plan.data / "test", group) for group in groups}
    else:
        counts = {group: COUNTS["test"].get(group, COUNTS["test"]["nuisance"]) for group in groups}
        names = {group: [one.name for one in session_plans("test", group, counts[group])] for group in groups}
    return {group: some for group, some in names.items() if some}
