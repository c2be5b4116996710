"""What a monitor makes of sessions: summaries that are written down once, alarms that follow as often as it changes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.config.monitor import MonitorExperiment, load_monitor_experiment
from edp.errors import DataError
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.chain import BlockVerdict, ChainState, MonitorChain
from edp.monitor.fitting import SessionBlocks, blocks_of, fit_from_blocks, fit_summaries, session_means
from edp.monitor.monitor import Monitor
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.monitor.residuals.base import FitMaterial, ResidualSource, sisters_of
from edp.monitor.summaries import BlockSummaries
from edp.recording import Recording
from edp.sim.plan import ordered
from edp.storage import make_folder, read_json, write_bytes, write_json
from edp.workflows.monitor import fit_to_recordings
from edp.workflows.monitor.dictionary import build_dictionary, machine_of
from edp.workflows.monitor.fit_monitor import FittedMonitor
from monitor_sessions import read_session, session_names

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
        networks: folder of an earlier monitor whose networks are taken over; None trains new ones.
        fits: of the promise.
    """

    data: Path
    monitor: Path
    hours: float
    minutes: float
    sessions: int
    workers: int
    quick: bool
    settings: tuple[str, ...]
    networks: Path | None = None
    fits: int = 20

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
    def of(monitor: Monitor, chain: MonitorChain | None = None) -> MonitorOfBlocks:
        """Of a monitor, with another chain where one is given."""
        source = monitor.chain if chain is None else chain
        own = ChainOfBlocks(**{field.name: getattr(source, field.name) for field in fields(MonitorChain)})
        values = {field.name: getattr(monitor, field.name) for field in fields(Monitor)}
        return MonitorOfBlocks(**values | {"chain": own})


@lru_cache(maxsize=1)
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


def blocks(plan: Plan, part: str, names: Sequence[str]) -> list[SessionBlocks]:
    """Summaries of sessions; those of an earlier run of the same monitor are read."""
    cache = make_folder(plan.monitor / "blocks" / part)
    jobs = [
        _Job(plan.data / part, name, plan.monitor, cache / f"{name}.npz", name)
        for name in names
        if not (cache / f"{name}.npz").exists()
    ]
    for number, name in enumerate(ordered(_summarise, jobs, plan.workers) if jobs else (), start=1):
        if number % 20 == 0:
            print(f"{part}: {number} of {len(jobs)} summarised, {name}", flush=True)
    result = []
    for name in names:
        with np.load(cache / f"{name}.npz", allow_pickle=False) as arrays:
            result.append(SessionBlocks(name, arrays["summaries"], arrays["points"]))
    return result


def watched(plan: Plan, names: Sequence[str]) -> dict[str, list[MonitorAlarm]]:
    """Alarms of test sessions by name; none where the monitor refuses a session as that of another machine."""
    monitor = MonitorOfBlocks.of(load_monitor(plan.monitor))
    found = {part.name: monitor.run(part) for part in blocks(plan, "test", names)}  # type: ignore[arg-type]
    for name in names:
        with np.load(plan.monitor / "blocks" / "test" / f"{name}.npz", allow_pickle=False) as arrays:
            if arrays["refused"]:
                print(f"{name}: refused as a session of another machine")
                found[name] = []
    return found


def same_alarms(plan: Plan, found: dict[str, list[MonitorAlarm]], count: int = 6) -> tuple[int, int]:
    """Of how many sessions with alarms `Monitor.run` raises the same ones, and of how many; and seconds a session."""
    monitor = load_monitor(plan.monitor)
    names = [name for name, alarms in found.items() if alarms][:count]
    same = 0
    for name in names:
        direct = monitor.run(read_session(plan.data / "test", name).recording)
        same += [alarm.raised_s for alarm in direct] == [alarm.raised_s for alarm in found[name]]
    return same, len(names)


def fitted(plan: Plan) -> dict[str, Any]:
    """Fit the monitor where it is not there yet; what is kept of it."""
    facts = plan.monitor / "fit.json"
    if not facts.exists():
        names = session_names(plan.data / "training", "healthy")[: plan.sessions]
        options = {"hours_per_false_alarm": plan.hours, "minutes": plan.minutes}
        experiment = load_monitor_experiment(None, plan.settings, options)
        if plan.networks is None:
            recordings = [read_session(plan.data / "training", name).recording for name in names]
            result = fit_to_recordings(recordings, experiment, note=noted)
        else:
            result = refitted(plan, load_monitor(plan.networks), experiment)
        save_monitor(result.monitor, plan.monitor)
        monitor = result.monitor
        write_json(
            facts,
            {
                "seconds": result.seconds,
                "promise": monitor.limit.sentence(),
                "limit": asdict(monitor.limit) | {"high_hours": min(monitor.limit.high_hours, NEVER_H)},
                "residuals": list(monitor.residual_names),
                "provenance": dict(monitor.provenance),
                "doubtful": list(result.doubtful),
            },
        )
    result_facts: dict[str, Any] = read_json(facts)
    return result_facts


def noted(text: str) -> None:
    """Progress of a fit."""
    print(f"fit: {text}", flush=True)


def refitted(plan: Plan, old: Monitor, experiment: MonitorExperiment) -> FittedMonitor:
    """A monitor with the networks of an earlier one; all else is fitted anew, to the same sessions as there.

    Training takes most of a fit, and is the same where settings of residuals and sessions are.
    """
    began = time.process_time()
    parts = [list(old.provenance[key]) for key in ("trained_on", "calibrated_on")]
    train, rest = ([read_session(plan.data / "training", name).recording for name in names] for names in parts)
    # The sessions that chose among weights stand last.
    cut = max(1, len(train) // 6)
    material = FitMaterial(train[:-cut], train[-cut:], old.channels, old.rate_hz, seed=experiment.seed, note=noted)
    sources = []
    for spec in experiment.residuals:
        source = next((source for source in old.sources if isinstance(source, spec.source)), None)
        fresh = source if source is not None and source.parts().bundles else spec.fit(material)
        sources += [] if fresh is None else [fresh]
    summaries = fit_summaries(experiment.chain, sources, old.channels, rest)
    held = []
    for number, recording in enumerate(rest):
        sisters = sisters_of(sources, experiment.chain.tolerance, number)
        held.append(_held(plan, summaries, sisters, old, recording))
    chain = fit_from_blocks(
        experiment.chain, summaries, held, old.rate_hz, old.chain.settle, experiment.hours_per_false_alarm, noted
    )
    means = session_means(old.channels, (*train, *rest))
    monitor = Monitor(old.channels, old.rate_hz, tuple(sources), chain.chain, chain.limit, means, None, old.provenance)
    machine = machine_of(experiment.dictionary, rest)
    if machine:
        dictionary = build_dictionary(monitor, rest, machine, experiment.dictionary, experiment.seed, _counted)
        monitor = replace(monitor, diagnosis=dictionary)
    return FittedMonitor(monitor, chain.doubtful, time.process_time() - began)


def _counted(what: str, done: int, total: int) -> None:
    if done % 50 == 0:
        print(f"fit: {what}: {done} of {total}", flush=True)


def _held(
    plan: Plan, summaries: BlockSummaries, sources: Sequence[ResidualSource], old: Monitor, recording: Recording
) -> SessionBlocks:
    """Summaries of a training session; those that were written down are read."""
    cache = make_folder(plan.monitor / "blocks" / "training") / f"{recording.name}.npz"
    if not cache.exists():
        part = blocks_of(summaries, sources, old.channels, recording)
        write_blocks(cache, part, refused=False)
    with np.load(cache, allow_pickle=False) as arrays:
        return SessionBlocks(recording.name, arrays["summaries"], arrays["points"])


def parts_of(plan: Plan) -> tuple[list[str], list[str]]:
    """Names of healthy training sessions: those that models are fitted to, and those that set limits."""
    names = session_names(plan.data / "training", "healthy")[: plan.sessions]
    limits = load_monitor(plan.monitor).provenance.get("calibrated_on")
    if not limits:
        limits = names[round(0.35 * len(names)) :]
    return [name for name in names if name not in set(limits)], list(limits)
