"""`edp fleet report`: evaluation of every machine of a store under one network, or its own delta."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, EdpError
from edp.jobs import Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import UNITS, UnitResult, WorkUnit, forget_units
from edp.logs.source import DataSource
from edp.networks.predictor import describe
from edp.networks.running import stream_errors
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.report.fleet.facts import FleetFacts, fleet_facts
from edp.report.fleet.page import build_fleet_page
from edp.report.fleet.result import (
    ErrorDrift,
    FleetReport,
    InputSpread,
    MachineAlarms,
    MachineErrors,
    RecordingError,
    ReportedMachine,
    ReportedNetwork,
    ReportedTarget,
)
from edp.signals import KINDS
from edp.storage import check_writable, read_bytes, write_json
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import files_below, full_path, status_of
from edp.training import Bundle, load_bundle
from edp.training.blas import one_blas_thread
from edp.training.bundle import weights_digest
from edp.training.delta import MOST_BYTES, apply_delta, read_delta
from edp.workflows.fleet.machines import MachineSource, StoredMachine, machines_of
from edp.workflows.fleet.personal import read_fleet
from edp.workflows.monitor import run_monitor

RESULT, PAGE = "fleet_report.json", "report.html"
BLOCK_S = 10.0
"""Blocks of which drift is told: longer than a network remembers what it misjudged."""
MIN_BLOCKS = 8
"""Minimum number of blocks in each half for a spread."""


@dataclass(frozen=True, kw_only=True)
class FleetQuestion:
    """Evaluation of a fleet: network, monitor and machines.

    Attributes:
        network: run folder or bundle.
        store: recordings that say their machine.
        deltas: folder of `edp train finetune --fleet`, whose deltas are added for the machines that have one.
        monitor: folder of a monitor that watches every machine.
    """

    network: Path
    store: Path
    deltas: Path | None = None
    monitor: Path | None = None


def report_fleet(
    workers: Workers,
    question: FleetQuestion,
    out: str | Path,
    progress: Progress = SILENT,
) -> FleetFacts:
    """Evaluate every machine, and write ``fleet_report.json`` and a page.

    Args:
        workers: who evaluates; nodes see all folders under the same paths.
        question: network, store, deltas, monitor.
        out: folder of the report.
        progress: receiver of the progress; its units are machines.

    Raises:
        EdpError: a network, store or monitor that cannot be used, or a folder that cannot be written.
    """
    bundle = load_bundle(question.network)
    machines = machines_of(question.store)
    folder = check_writable(out)
    deltas = {} if question.deltas is None else _deltas(question.deltas)
    digest = weights_digest(bundle.predictor)
    units = [_unit(machine, digest, question, deltas.get(machine.name)) for machine in machines]

    machines_done = progress.stage("machine", len(units))

    results = list(workers.map_in_order(units, machines_done, folder / UNITS))
    task = bundle.task
    report = FleetReport(
        network=ReportedNetwork(str(question.network), digest, describe(bundle.predictor.spec)),
        store=str(question.store),
        deltas=None if question.deltas is None else str(question.deltas),
        monitor=None if question.monitor is None else str(question.monitor),
        horizon=task.horizons[0],
        rate_hz=task.rate_hz,
        targets=tuple(
            ReportedTarget(name, KINDS[kind].report_unit)
            for name, kind in zip(task.targets, bundle.target_kinds, strict=True)
        ),
        machines=tuple(_make_report(machine, result) for machine, result in zip(machines, results, strict=True)),
    )
    write_json(folder / RESULT, report.to_json())
    facts = fleet_facts(report, full_path(Path(question.store)).name)
    build_fleet_page(facts).write(folder / PAGE)
    forget_units(folder / UNITS)
    return facts


def _make_report(machine: StoredMachine, result: UnitResult) -> ReportedMachine:
    if result.content is None:
        return ReportedMachine(machine.name, machine.minutes, failed=str(result.values["failed"]))
    return ReportedMachine(machine.name, machine.minutes, unpack(result.content, MachineErrors))


def _deltas(folder: Path) -> dict[str, Path]:
    """Return the files of deltas by machine."""
    return {row.machine: folder / row.delta for row in read_fleet(folder).machines if row.delta is not None}


def _unit(machine: StoredMachine, digest: str, question: FleetQuestion, delta: Path | None) -> WorkUnit:
    monitor = question.monitor
    arguments = {
        "machine": machine.name,
        "weights": digest,
        "delta": None if delta is None else _hash(read_bytes(delta, MOST_BYTES)),
        "monitor": None if monitor is None else _state_of(monitor),
    }
    where = {
        "network": str(full_path(question.network)),
        "store": str(full_path(question.store)),
        "delta": None if delta is None else str(full_path(delta)),
        "monitor": None if monitor is None else str(full_path(monitor)),
    }
    return WorkUnit(f"{__name__}:judge_machine", machine.name, arguments, " ".join(machine.digests), where)


def _hash(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def _state_of(folder: Path) -> str:
    """Return the names, sizes and times of the files of a folder, as one hash."""
    files = sorted(files_below(folder))
    facts = [(str(file.relative_to(folder)), status_of(file).st_size, status_of(file).st_mtime_ns) for file in files]
    return _hash(repr(facts).encode())


@one_blas_thread()
def judge_machine(identity: TrainingIdentity, where: Mapping[str, str | None]) -> WithState | dict[str, str]:
    """Return errors, drift, inputs and alarms of one machine, or why it cannot be evaluated."""
    bundle = _bundle(str(where["network"]), identity.config["weights"])
    source = MachineSource(Path(str(where["store"])), machine=identity.config["machine"])
    try:
        return WithState({}, pack(_errors_of(bundle, source, where)))
    except EdpError as error:
        # A machine with other channels than the network's must not end the fleet's report.
        return {"failed": str(error)}


def _errors_of(bundle: Bundle, source: MachineSource, where: Mapping[str, str | None]) -> MachineErrors:
    """Evaluate a machine.

    Raises:
        EdpError: its recordings do not go with the network, or are too short.
    """
    recordings = source.read()
    task, network = bundle.task, bundle.predictor
    series = [task.series(recording) for recording in recordings]
    delta, monitor = where["delta"], where["monitor"]
    if delta is not None:
        network = apply_delta(network, read_delta(delta))
    factor = np.array([KINDS[kind].report_factor for kind in bundle.target_kinds])
    errors = [np.abs(error) * factor for horizon, error in stream_errors(network, series) if horizon == 0]
    if not errors:
        shortest = task.max_horizon + network.spec.window
        raise DataError(f"no recording is longer than window and horizon together, {shortest} samples")
    start, k = network.spec.window, task.horizons[0]
    still = [np.abs(part.targets[start + k :] - part.targets[start : part.samples - k]) * factor for part in series]
    pooled = np.concatenate(errors)
    return MachineErrors(
        mae=float(pooled.mean()),
        by_target=tuple(float(value) for value in pooled.mean(axis=0)),
        persistence=float(np.concatenate([part for part in still if len(part)]).mean()),
        recordings=tuple(RecordingError(part.name, float(one.mean())) for part, one in zip(series, errors)),
        drift=drift_of(np.concatenate([error.mean(axis=1) for error in errors]), task.rate_hz),
        inputs=_inputs(recordings, [channel.name for channel in bundle.inputs]),
        own=delta is not None,
        alarms=None if monitor is None else _alarms(Path(monitor), source),
    )


def drift_of(error: NDArray[np.floating], rate_hz: float) -> ErrorDrift | None:
    """Return the ratio of the errors of the two halves of the time, by blocks.

    Args:
        error: absolute error a tick, in the order of time.
        rate_hz: ticks a second.

    Returns:
        None where there are too few blocks.
    """
    size = round(BLOCK_S * rate_hz)
    blocks = error[: len(error) // size * size].reshape(-1, size).mean(axis=1)
    half = len(blocks) // 2
    if half < MIN_BLOCKS:
        return None
    first, second = blocks[:half], blocks[half:]
    spread = float(np.sqrt(first.var(ddof=1) / len(first) + second.var(ddof=1) / len(second)))
    difference = float(second.mean() - first.mean())
    return ErrorDrift(float(second.mean() / max(first.mean(), 1e-30)), difference / spread if spread else 0.0)


def _inputs(recordings: list[Recording], names: list[str]) -> dict[str, InputSpread]:
    """Return the mean and deviation of each input, SI units."""
    values = np.concatenate([recording.select(names) for recording in recordings]).astype(np.float64)
    means, spreads = values.mean(axis=0), values.std(axis=0)
    return {name: InputSpread(float(m), float(s)) for name, m, s in zip(names, means, spreads, strict=True)}


def _alarms(monitor: Path, source: DataSource) -> MachineAlarms:
    """Return the number of changes that a monitor reported with the first one, or why it could not run."""
    try:
        watched = run_monitor(monitor, source)
    except EdpError as error:
        return MachineAlarms(failed=str(error))
    changes = watched.changes
    first = tuple(same[0].sentence for same in changes[:3])
    return MachineAlarms(len(changes), len(watched.alarms), watched.hours, first)


@lru_cache(maxsize=1)
def _bundle(path: str, digest: str) -> Bundle:
    return load_bundle(path)
