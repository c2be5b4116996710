"""The dictionary of a monitor: faults simulated on the user's machine, seen through the monitor."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.config.monitor import AUTOMATIC, NO_MACHINE, DictionarySpec, MonitorExperiment
from edp.errors import ConfigError, DataError
from edp.monitor.diagnosis.causes import FaultClass
from edp.monitor.diagnosis.evidence import ONSET, mean_features, parts_of
from edp.monitor.diagnosis.learning import SimulatedFault, check_healthy_blocks, fit_dictionary
from edp.monitor.diagnosis.signatures import Dictionary
from edp.monitor.fitting import count_watched_blocks
from edp.monitor.monitor import Monitor
from edp.monitor.residuals.base import ONE_BY_ONE, SideBySide
from edp.monitor.session_blocks import block_ticks
from edp.progress import SILENT, Progress
from edp.recording import MACHINE, Recording
from edp.signals import Channel
from edp.sim.machine.machine_files import load_machine, machine_names
from edp.storage.reading import Table
from edp.wording import typed
from edp.workflows.monitor.fault_sessions import (
    FaultSession,
    add_noise,
    cases_of,
    fault_classes,
    mirrors,
    noise_of,
    simulated,
)

Array = NDArray[np.float64]
HEALTHY_SESSIONS = 30
"""Number of sessions for the scatter of healthy means; more sessions change little."""
QUIET = ("CylStroke_1", "CylStroke_2", "CylStroke_3", "PumpPressure_1", "PumpPressure_2", "OilTemperature")
"""Channels that the simulator shows without noise: theirs is taken from the healthy logs."""
FURTHER = (
    *QUIET,
    *(f"JointAngle_{axis}" for axis in (1, 2, 3)),
    *(f"PumpDisplacement_{pump}" for pump in (1, 2)),
    *(f"SpoolPos_{spool}" for spool in range(1, 7)),
)
"""Channels that a machine may have sensors for, beyond Table A.1."""


def machine_of(spec: DictionarySpec, recordings: Sequence[Recording]) -> str:
    """Return the machine to simulate, from the settings or from all logs; empty without one."""
    if spec.machine == NO_MACHINE:
        return ""
    if spec.machine != AUTOMATIC:
        return spec.machine
    named = {str(recording.meta.get(MACHINE, "")) for recording in recordings}
    only = next(iter(named)) if len(named) == 1 else ""
    # A name of a file that came with a log is not followed to wherever it leads.
    return only if only in machine_names() else ""


def check_dictionary(spec: DictionarySpec) -> None:
    """Refuse a machine or a kind of fault that cannot be before networks are trained.

    Raises:
        EdpError: an unknown machine, a file that holds none, or an unknown kind.
    """
    if spec.machine not in (AUTOMATIC, NO_MACHINE):
        load_machine(spec.machine)
    fault_classes(spec.kinds or None)


def check_dictionary_inputs(
    experiment: MonitorExperiment, channels: Sequence[Channel], healthy: Sequence[Recording]
) -> None:
    """Refuse logs and a machine from which no dictionary could be made, before residuals are fitted.

    Lengths and channels alone tell it; sessions that turn out doubtful can still leave too little.

    Args:
        experiment: settings.
        channels: raw inputs of the monitor.
        healthy: sessions that no residual is fitted to.

    Raises:
        ConfigError: a machine that lacks the monitor's channels, or seconds too short for the blocks.
        DataError: too few healthy blocks.
    """
    spec = experiment.dictionary
    machine = machine_of(spec, healthy)
    if not machine:
        return
    rate = healthy[0].rate_hz
    block = block_ticks(experiment.chain.block_s, healthy)
    check_healthy_blocks(count_watched_blocks(experiment.chain, healthy)[:HEALTHY_SESSIONS])
    if round((spec.before_s + spec.after_s) * rate) // block - int(spec.before_s * rate / block) <= ONSET:
        raise _too_short(block / rate)
    _check_machine([channel.name for channel in channels], machine, rate)


def _too_short(block_s: float) -> ConfigError:
    return ConfigError(f"dictionary: after_s must hold more than {ONSET} blocks of {typed(block_s)} s")


def _check_machine(inputs: Sequence[str], machine: str, rate_hz: float) -> None:
    session = next(simulated((), machine, (0.0, 1.0), (0, 0), rate_hz)).recording
    if not set(inputs) & set(session.channel_names):
        raise ConfigError(
            f"dictionary: the simulated machine '{machine}' has none of the monitor's channels, such as "
            f"'{inputs[0]}'; map the logs to the names of Table A.1, or leave the dictionary out (--machine none)"
        )


def build_dictionary(
    monitor: Monitor,
    healthy: Sequence[Recording],
    machine: str,
    spec: DictionarySpec,
    seed: int = 0,
    progress: Progress = SILENT,
    side_by_side: SideBySide = ONE_BY_ONE,
) -> Dictionary:
    """Simulate every fault at every site and size on a machine, and learn its effect on the monitor.

    The same seed gives the same dictionary, unless the time allows fewer draws; it says how many there were.

    Args:
        monitor: fitted.
        healthy: sessions that its networks were not fitted to.
        machine: name or file.
        spec: settings of the dictionary.
        seed: root of every random choice.
        progress: receiver of the progress; its units are draws, divided into sessions.
        side_by_side: calls a function for each of some jobs, such as in processes; then all draws are made, whatever
            the time, and single sessions are not reported.

    Raises:
        ConfigError: a machine that lacks the monitor's channels.
        DataError: too few healthy sessions.
    """
    began = time.process_time()
    _check_machine(monitor.inputs, machine, monitor.rate_hz)
    rows = [monitor.conditioned_rows(session) for session in healthy[:HEALTHY_SESSIONS]]
    rows = [part[np.isfinite(part).any(axis=1)] for part in rows]
    if not rows:
        raise DataError("a dictionary needs healthy sessions that no network was fitted to; bring more")
    check_healthy_blocks([len(part) for part in rows])
    classes = fault_classes(spec.kinds or None)
    plan = _Plan(machine, (spec.before_s, spec.after_s), seed, _missing_noise(monitor, healthy, machine, seed))
    drawing = progress.stage("draw", spec.draws)
    shown = SILENT if side_by_side.is_elsewhere else drawing
    jobs = [DrawJob(monitor, classes, plan, draw, shown) for draw in range(spec.draws)]
    faults: list[SimulatedFault] = []
    draws, spent = 0, 0.0
    drawing.note(f"faults on {machine}")
    for part in side_by_side(draw_faults, jobs):
        faults += part.faults
        draws, spent = draws + 1, spent + part.seconds
        drawing.step(draws)
        # Two draws at least, then as many as the time allows.
        if not side_by_side.is_elsewhere and draws >= 2 and spent * (draws + 1) / draws > 60.0 * spec.time_budget_min:
            break
    provenance: Table = {
        "machine": machine, "seed": seed, "draws": draws, "sessions": len(faults),
        "seconds_each": spec.before_s + spec.after_s, "processor_s": round(time.process_time() - began, 1),
    }  # fmt: skip
    return fit_dictionary(monitor.summary_names, classes, faults, rows, provenance, seed)


@dataclass(frozen=True)
class _Plan:
    """Common values of all draws: machine, seconds before and after the onset, seed, noise by channel."""

    machine: str
    seconds: tuple[float, float]
    seed: int
    added: dict[str, float]


@dataclass(frozen=True)
class DrawJob:
    """One draw of the dictionary."""

    monitor: Monitor
    classes: Sequence[FaultClass]
    plan: _Plan
    number: int
    progress: Progress = SILENT

    @property
    def label(self) -> str:
        """For messages."""
        return f"draw {self.number + 1} of the dictionary"


@dataclass(frozen=True, eq=False)
class DrawnFaults:
    """Faults of one draw, and the processor time that they took."""

    faults: tuple[SimulatedFault, ...]
    seconds: float


def draw_faults(job: DrawJob) -> DrawnFaults:
    """Simulate the sessions of one draw."""
    began = time.process_time()
    faults = tuple(_draw(job.monitor, job.classes, job.plan, job.number, job.progress))
    return DrawnFaults(faults, time.process_time() - began)


def _draw(
    monitor: Monitor, classes: Sequence[FaultClass], plan: _Plan, draw: int, progress: Progress
) -> list[SimulatedFault]:
    """Return all sessions of one draw, each less its sound twin."""
    before = plan.seconds[0]
    further = [name for name in FURTHER if name not in monitor.inputs]
    total, mirrored = len(cases_of(classes)), mirrors(classes)
    sound: dict[int, tuple[Array, dict[str, Array]]] = {}
    faults: list[SimulatedFault] = []
    done, sessions = 0, progress.stage("session", total)
    for session in simulated(classes, plan.machine, plan.seconds, (plan.seed, draw), monitor.rate_hz):
        noisy = add_noise(session.recording, plan.added, [plan.seed, draw, session.base])
        seen = _average_blocks(monitor, noisy, before), _summarise_channels(session, further, before)
        if session.fault < 0:
            sound[session.base] = seen
            continue
        features, sensors = sound[session.base]
        change = np.nan_to_num(seen[0] - features, nan=0.0)
        shown = {name: seen[1][name] - sensors[name] for name in further}
        faults.append(SimulatedFault(draw, session.fault, session.size, change, shown))
        done += 1
        if session.fault in mirrored:
            faults.append(SimulatedFault(draw, mirrored[session.fault], -session.size, _mirror(change), shown))
        sessions.step(done)
    return _standardise(faults, sound)


def _mirror(change: Array) -> Array:
    """Return the change by a fault of the other sign: means change sign, sizes do not."""
    means, sizes = np.split(change, 2, axis=1)
    return np.concatenate([-means, sizes], axis=1)


def _average_blocks(monitor: Monitor, recording: Recording, onset_s: float) -> Array:
    """Return the mean features of the blocks at an onset and of those after it, shape (2, features)."""
    rows = monitor.conditioned_rows(recording)
    at, after = parts_of(rows[int(onset_s / monitor.block_s) :])
    if at is None or after is None:
        raise _too_short(monitor.block_s)
    return np.stack([mean_features(at), mean_features(after)])


def _summarise_channels(session: FaultSession, names: Sequence[str], onset_s: float) -> dict[str, Array]:
    """Return level, width and rate of change of additional channels after an onset."""
    shown = {}
    first = round(onset_s * session.recording.rate_hz)
    for name in names:
        values = session.recording.column(name)[first:].astype(np.float64)
        shown[name] = np.array([values.mean(), values.std(), np.abs(np.diff(values)).mean()])
    return shown


def _standardise(
    faults: Sequence[SimulatedFault], sound: dict[int, tuple[Array, dict[str, Array]]]
) -> list[SimulatedFault]:
    """Return changes of additional channels relative to their scatter between sound sessions."""
    names = sorted(next(iter(sound.values()))[1])
    width = {name: np.std([sensors[name] for _, sensors in sound.values()], axis=0) for name in names}
    return [
        SimulatedFault(
            fault.draw, fault.owner, fault.size, fault.change,
            {name: fault.sensors[name] / np.maximum(width[name], 1e-12) for name in names},
        )
        for fault in faults
    ]  # fmt: skip


def _missing_noise(monitor: Monitor, healthy: Sequence[Recording], machine: str, seed: int) -> dict[str, float]:
    """Return the noise that healthy logs have on channels which the simulator shows without."""
    names = [name for name in QUIET if name in monitor.inputs]
    session = next(simulated((), machine, (0.0, 60.0), (seed, 0), monitor.rate_hz)).recording
    shown = noise_of(session, names)
    logs = [noise_of(recording, names) for recording in healthy[:8]]
    real = {name: float(np.median([sizes[name] for sizes in logs])) for name in names}
    return {name: float(np.sqrt(max(real[name] ** 2 - shown[name] ** 2, 0.0))) for name in names}
