"""From runs of a machine and healthy logs of it to a monitor."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from edp.config.monitor import MonitorExperiment, monitor_toml
from edp.errors import ConfigError, DataError, closest
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import UNITS, forget_units
from edp.logs.source import DataSource
from edp.monitor.detectable import effort_line, found_sizes, healthy_range, measure_found_sizes, promise_lines
from edp.monitor.fitting import FittedChain, check_healthy_sessions, doubtful_sessions, fit_chain
from edp.monitor.machine_offsets import scatter_of
from edp.monitor.monitor import Monitor
from edp.monitor.monitor_file import load_monitor, save_monitor
from edp.monitor.residuals.base import ONE_BY_ONE, FitMaterial, ResidualSource, ResidualSpec, SideBySide
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.residuals.groups import Group, select_sensed
from edp.monitor.residuals.virtual_sensors import VirtualSensorsSpec
from edp.monitor.session_blocks import SessionBlocks, session_means
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.provenance import new_provenance
from edp.signals import Channel
from edp.storage import write_json
from edp.storage.headers import model_digest
from edp.storage.paths import is_there
from edp.storage.provenance import PROVENANCE
from edp.storage.reading import object_with
from edp.storage.runs import Run, check_claimable, run_key
from edp.training.blas import one_blas_thread
from edp.training.bundle import Bundle, load_bundle
from edp.training.twin_bundle import TwinBundle, holds_twin, load_twin
from edp.wording import percent, typed
from edp.workflows.monitor.dictionary import build_dictionary, check_dictionary, check_dictionary_inputs, machine_of
from edp.workflows.monitor.fit_units import UnitMap

MIN_SESSIONS = 8
"""Minimum number of healthy sessions: two for training, one for selection, and some for the limit."""
CUT_S = 480.0
"""Length of the segments into which sessions are cut if there are too few."""
ROOM = 0.8
"""Fraction of the hours that set the limit, for advice: doubtful sessions are omitted after the training."""


@dataclass(frozen=True, eq=False)
class FittedMonitor:
    """Fitted monitor with notes on its fit.

    Attributes:
        monitor: ready to run.
        doubtful: names of healthy sessions that were left out.
        seconds: processor time of this process.
        folder: folder of the monitor; None if it was not saved.
        sessions: blocks of those that set the limit.
        is_read: whether the folder held the finished monitor already.
        one_machine: it knows the machine of the logs so well that others of its series raise alarms.
    """

    monitor: Monitor
    doubtful: tuple[str, ...]
    seconds: float
    folder: Path | None = None
    sessions: tuple[SessionBlocks, ...] = ()
    one_machine: bool = False
    is_read: bool = False

    @property
    def finds(self) -> list[str]:
        """Sentences about the changes that the monitor detects with these logs."""
        provenance = self.monitor.provenance
        stopped = effort_line(provenance)
        return [*promise_lines(found_sizes(provenance)), *([stopped] if stopped else [])]


def fit_monitor(
    runs: Sequence[str | Path],
    source: DataSource,
    experiment: MonitorExperiment,
    out: str | Path,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> FittedMonitor:
    """Fit a monitor to healthy logs and write its folder.

    Args:
        runs: run folders of networks or twins of this machine; may be empty.
        source: healthy logs.
        experiment: settings.
        out: folder of the monitor; that of a finished fit with the same settings and logs is read.
        progress: receiver of what begins.
        workers: who fits; nodes see the run folder under the same path. The monitor does not depend on it, unless the
            dictionary has not the time for all of its draws: several processes make them all.

    Raises:
        EdpError: runs or logs that cannot be used, or too few hours for the expected error, or a process died.
    """
    check_claimable(out, "monitor")
    bundles = [_network_of(run) for run in runs]
    recordings = source.read()
    _healthy_sessions(recordings, experiment)  # what is refused must not keep a corrected command out of the folder
    settings = monitor_toml(experiment)
    models = [model_digest(run) for run in runs]
    origin = source.origin(recordings)
    key = run_key({"monitor": settings, "models": models}, origin.digest or "")
    with Run.create(out, "monitor", key, settings) as opened:
        if opened.is_finished:
            return _read_fitted(opened.path, experiment)
        with workers.stay() as staying:
            side_by_side = UnitMap(staying, opened.path, key)
            fitted = fit_to_recordings(recordings, experiment, bundles, progress, side_by_side=side_by_side)
        fitted = replace(fitted, seconds=fitted.seconds + side_by_side.seconds)
        provenance = replace(new_provenance(origin), seed=experiment.seed, seconds=round(fitted.seconds, 2))
        write_json(opened.file(PROVENANCE), provenance.to_table())
        fitted = replace(fitted, folder=save_monitor(fitted.monitor, opened.path))
    forget_units(opened.path / UNITS)
    return fitted


def _read_fitted(folder: Path, experiment: MonitorExperiment) -> FittedMonitor:
    """Return the monitor of a finished run."""
    monitor = load_monitor(folder)
    provenance = object_with(monitor.provenance, ("doubtful", "seconds"), f"monitor '{folder}', its provenance,")
    alone = _fits_one_machine(experiment, monitor.sources)
    doubtful, seconds = tuple(provenance["doubtful"]), provenance["seconds"]
    return FittedMonitor(monitor, doubtful, seconds, folder, one_machine=alone, is_read=True)


def _fits_one_machine(experiment: MonitorExperiment, sources: Sequence[ResidualSource]) -> bool:
    return not experiment.chain.tolerance and any(isinstance(source, FlowBalances) for source in sources)


def holds_model(path: str | Path) -> bool:
    """Return whether a path is a run folder or a bundle, finished or not, in place of logs."""
    return any(is_there(Path(path) / name) for name in ("bundle", "bundle.json", "run.json", "twin"))


def _network_of(run: str | Path) -> Bundle | TwinBundle:
    """Return the network or twin of a run.

    Raises:
        BundleError: the folder holds none, or is damaged.
    """
    return load_twin(run) if holds_twin(run) else load_bundle(run)


@one_blas_thread()
def fit_to_recordings(
    recordings: Sequence[Recording],
    experiment: MonitorExperiment,
    bundles: Sequence[Bundle | TwinBundle] = (),
    progress: Progress = SILENT,
    again: bool = False,
    side_by_side: SideBySide = ONE_BY_ONE,
) -> FittedMonitor:
    """Return `fit_monitor` without files.

    Args:
        recordings: healthy logs.
        experiment: settings.
        bundles: networks and twins of this machine.
        progress: receiver of what begins.
        again: doubtful sessions were left out of the training before.
        side_by_side: calls a function for each of some jobs, such as in processes.

    Raises:
        EdpError: recordings that cannot be used, or too few hours for the expected error.
    """
    began = time.process_time()
    divided = _healthy_sessions(recordings, experiment)
    channels, sessions, rest = divided.channels, divided.sessions, divided.rest
    train, validation = divided.train, divided.validation
    material = FitMaterial(
        train=train,
        validation=validation,
        channels=channels,
        rate_hz=recordings[0].rate_hz,
        predictors=tuple(bundle for bundle in bundles if isinstance(bundle, Bundle)),
        twins=tuple(bundle for bundle in bundles if isinstance(bundle, TwinBundle)),
        groups=experiment.groups,
        seed=experiment.seed,
        minutes=experiment.time_budget_min,
        progress=progress,
    )
    sources = _sources(experiment, material, side_by_side)
    fitted = fit_chain(
        experiment.chain, sources, channels, rest, experiment.hours_per_false_alarm, progress, side_by_side
    )
    if not again:
        progress.note("sessions that trained, compared with the others")
        trained = doubtful_sessions(fitted, experiment.chain, sources, channels, (*train, *validation), side_by_side)
        if trained:
            progress.note(f"once more without {', '.join(trained)}")
            left = [session for session in sessions if session.name not in trained]
            better = fit_to_recordings(left, experiment, bundles, progress, True, side_by_side)
            seconds = time.process_time() - began
            return replace(better, doubtful=(*trained, *better.doubtful), seconds=seconds)
    monitor = _assemble_monitor(material, sources, fitted, sessions, rest)
    # Validation sessions set no limit.
    minutes = 60.0 * float(monitor.provenance["hours"])
    fit_s = time.process_time() - began + (side_by_side.seconds if isinstance(side_by_side, UnitMap) else 0.0)
    trials = measure_found_sizes(monitor, validation, minutes, fit_s, progress)
    measured = {"found_sizes": [asdict(size) for size in trials.sizes], "found_effort": trials.effort()}
    measured["healthy_range"] = healthy_range(fitted)
    healthy = [session for session in rest if session.name not in fitted.doubtful]
    provenance = dict(monitor.provenance) | measured | {"seconds": time.process_time() - began}
    monitor = _add_dictionary(replace(monitor, provenance=provenance), healthy, experiment, progress, side_by_side)
    alone = _fits_one_machine(experiment, sources)
    return FittedMonitor(monitor, fitted.doubtful, time.process_time() - began, None, fitted.sessions, alone)


def _assemble_monitor(
    material: FitMaterial,
    sources: tuple[ResidualSource, ...],
    fitted: FittedChain,
    sessions: Sequence[Recording],
    rest: Sequence[Recording],
) -> Monitor:
    """Return the monitor without a dictionary; `rest` are the sessions outside the training of residuals."""
    doubtful = fitted.doubtful
    provenance: dict[str, object] = {
        "sessions": len(sessions),
        "hours": sum(session.duration_s for session in sessions) / 3600.0,
        "doubtful": list(doubtful),
        "trained_on": [session.name for session in (*material.train, *material.validation)],
        "calibrated_on": [session.name for session in rest if session.name not in doubtful],
        "seed": material.seed,
    }
    return Monitor(
        *(material.channels, material.rate_hz, sources, fitted.chain, fitted.limit),
        session_means(material.channels, sessions),
        provenance=provenance,
        scatter=scatter_of(fitted.chain, fitted.sessions, fitted.chain.summaries.block / material.rate_hz),
    )


def _add_dictionary(
    monitor: Monitor,
    healthy: Sequence[Recording],
    experiment: MonitorExperiment,
    progress: Progress,
    side_by_side: SideBySide,
) -> Monitor:
    """Return the monitor with a dictionary of faults, if there is a machine to simulate."""
    machine = machine_of(experiment.dictionary, healthy)
    if not machine:
        return monitor

    dictionary = build_dictionary(
        monitor, healthy, machine, experiment.dictionary, experiment.seed, progress, side_by_side
    )
    return replace(monitor, diagnosis=dictionary)


def select_watched(recordings: Sequence[Recording], experiment: MonitorExperiment) -> tuple[Channel, ...]:
    """Return the channels of the settings, or the measurable channels that all recordings have.

    Raises:
        DataError: a named channel is missing, rates differ, or fewer than two channels are left.
    """
    if not recordings:
        raise DataError("there are no healthy logs; give a log or a folder of logs")
    first = recordings[0]
    rates = sorted({recording.rate_hz for recording in recordings})
    if rates[-1] > rates[0] * 1.001:
        raise DataError(
            f"healthy logs have rates from {typed(rates[0])} to {typed(rates[-1])} Hz; set rate_hz in the signal map"
        )
    for name in experiment.channels:
        for recording in recordings:
            if name not in recording.channel_names:
                hint = closest(name, recording.channel_names)
                raise DataError(f"healthy log '{recording.name}' has no channel '{name}'{hint}")
    shared = set(first.channel_names).intersection(*(recording.channel_names for recording in recordings))
    offered = [channel for channel in select_sensed(first.channels) if channel.name in shared]
    chosen = experiment.channels or tuple(channel.name for channel in offered)
    channels = tuple(channel for channel in first.channels if channel.name in chosen)
    if len(channels) < 2:
        raise DataError(f"{len(channels)} channel can be watched; a monitor compares two at least: map more columns")
    return channels


def _check_values(recordings: Sequence[Recording], channels: Sequence[Channel]) -> None:
    """Raise an error for missing values, since networks train on healthy logs without gaps."""
    names = [channel.name for channel in channels]
    for recording in recordings:
        bad = ~np.isfinite(recording.select(names))
        if bad.any():
            row, which = (int(i) for i in np.argwhere(bad)[0])
            raise DataError(
                f"healthy log '{recording.name}': channel '{names[which]}' has missing values, the first at row {row}; "
                'allow a repair (nan = "hold"), or leave the channel out'
            )


def _enough_sessions(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings, cut into segments if they are few."""
    if len(recordings) >= MIN_SESSIONS:
        return list(recordings)
    pieces = []
    for recording in recordings:
        longest = round(CUT_S * recording.rate_hz)
        least = -(-2 * MIN_SESSIONS // len(recordings))
        count = max(-(-recording.samples // longest), least)
        edges = np.linspace(0, recording.samples, count + 1).astype(int).tolist()
        pieces += [recording.rows(a, b) for a, b in itertools.pairwise(edges) if b > a]
    return pieces


@dataclass(frozen=True, eq=False)
class _Fit:
    """A source to fit, or the network of one group of virtual sensors."""

    spec: ResidualSpec
    material: FitMaterial
    group: Group | None = None
    groups: int = 1

    @property
    def label(self) -> str:
        """For messages."""
        return type(self.spec).__name__ if self.group is None else f"virtual sensors of {self.group.name}"


def fit_source(job: _Fit) -> ResidualSource | Bundle | None:
    """Fit a source of residuals, or the network of one group."""
    if isinstance(job.spec, VirtualSensorsSpec) and job.group is not None:
        job.material.progress.note(job.label)
        return job.spec.network(job.group, job.material, job.groups)
    return job.spec.fit(job.material)


def _sources(
    experiment: MonitorExperiment, material: FitMaterial, side_by_side: SideBySide = ONE_BY_ONE
) -> tuple[ResidualSource, ...]:
    """Return the residuals of the settings that have channels to evaluate.

    Raises:
        DataError: no residual of the settings has channels to evaluate.
    """
    jobs = []
    # Other processes cannot call what shows progress here.
    if side_by_side.is_elsewhere:
        progress, material = material.progress, replace(material, progress=SILENT)
    for spec in experiment.residuals:
        groups = spec.groups(material) if isinstance(spec, VirtualSensorsSpec) else (None,)
        jobs += [_Fit(spec, material, group, len(groups)) for group in groups]
    fits: dict[ResidualSpec, ResidualSource | None] = {}
    networks: dict[ResidualSpec, dict[str, Bundle]] = {}
    for job, result in zip(jobs, side_by_side(fit_source, jobs), strict=True):
        if side_by_side.is_elsewhere:
            progress.note(f"{job.label}, done")
        if job.group is None:
            fits[job.spec] = result
        elif result is not None and isinstance(job.spec, VirtualSensorsSpec):
            networks.setdefault(job.spec, {})[job.group.name] = result
            fits[job.spec] = job.spec.together(networks[job.spec], material)
    sources = tuple(source for spec in experiment.residuals if (source := fits.get(spec)) is not None)
    if not sources:
        raise DataError(
            "none of the settings' residuals finds something to judge in these channels; name further channels or "
            "residuals"
        )
    return sources


def _check_hours(sessions: Sequence[Recording], rest: Sequence[Recording], experiment: MonitorExperiment) -> None:
    """Raise an error for a false-alarm rate that the hours of data cannot support, before any training.

    Args:
        sessions: all of them.
        rest: sessions that train nothing and set the limit.
        experiment: experiment with the expected false-alarm rate.
    """
    hours = sum(session.duration_s for session in sessions) / 3600.0
    left = sum(session.duration_s for session in rest) / 3600.0
    promised = experiment.hours_per_false_alarm
    if left < promised:
        share = left / hours
        raise ConfigError(
            f"{typed(hours, 3)} h of healthy logs are too few for one false alarm in {typed(promised)} h: "
            f"{percent(1.0 - share)} of them train residuals, and what is left supports one in {typed(left, 3)} h; "
            f"ask for one in {typed(ROOM * left, 3)} (--hours-per-false-alarm {typed(ROOM * left, 3)}), which leaves "
            f"room for sessions that turn out doubtful, or bring {typed(promised / (ROOM * share) - hours, 3)} h more"
        )


@dataclass(frozen=True, eq=False)
class _HealthySessions:
    """Healthy sessions: for training of residuals, for choice among fits, and for the limit."""

    channels: tuple[Channel, ...]
    sessions: list[Recording]
    train: list[Recording]
    validation: list[Recording]
    rest: list[Recording]


def _healthy_sessions(recordings: Sequence[Recording], experiment: MonitorExperiment) -> _HealthySessions:
    """Divide healthy logs into random sessions, and check that they suffice for a monitor.

    Raises:
        DataError: channels, values or hours that a monitor cannot be fitted to.
        ConfigError: a dictionary that cannot be.
    """
    check_dictionary(experiment.dictionary)
    channels = select_watched(recordings, experiment)
    _check_values(recordings, channels)
    sessions = _enough_sessions(recordings)
    order = np.random.default_rng(experiment.seed).permutation(len(sessions)).tolist()
    total, drawn = sum(session.samples for session in sessions), 0
    count = 0
    for count, index in enumerate(order, start=1):
        drawn += sessions[index].samples
        if drawn >= experiment.train_fraction * total and count >= 2:
            break
    count = min(count, len(sessions) - 4)
    chosen = [sessions[i] for i in order[:count]]
    cut = max(1, count // 6)
    rest = [sessions[i] for i in sorted(order[count:])]
    _check_hours(sessions, rest, experiment)
    check_healthy_sessions(experiment.chain, channels, rest)
    check_dictionary_inputs(experiment, channels, rest)
    return _HealthySessions(channels, sessions, chosen[cut:], chosen[:cut], rest)
