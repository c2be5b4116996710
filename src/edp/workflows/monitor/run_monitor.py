"""A monitor along logs: alarms as JSON lines and as CSV, and traces for the page."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from edp.jobs import IN_PROCESS, Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import UNITS, WorkUnit, forget_units
from edp.logs.source import DataSource
from edp.monitor.alarms import MonitorAlarm, episodes
from edp.monitor.detectable import found_sizes, outside_line, unseen_line
from edp.monitor.monitor import Monitor, Watched
from edp.monitor.monitor_file import load_monitor
from edp.monitor.run_file import MonitorRunFile
from edp.monitor.traces import RecordingTrace, RunTraces, write_traces
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.report.monitor.facts import start_time
from edp.settings.provenance import new_provenance
from edp.storage import write_bytes, write_json
from edp.storage.headers import digests_of, model_digest
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import Run, check_claimable, run_key

ALARM_LOG = "alarms.jsonl"
START = "start"
"""Key of the start time in the metadata of a recording, ISO 8601 text."""

COLUMNS = (
    *("recording", "raised_s", "since_s", "severity", "sentence", "detector", "statistic", "limit"),
    *("component", "kind", "site", "size", "unit", "at_fault", "probability", "evidence"),
)
"""Columns of the CSV file, with the most probable cause."""


@dataclass(frozen=True, eq=False)
class MonitorRun:
    """Result of a monitor along logs.

    Attributes:
        monitor: monitor of the run.
        alarms: alarms of all recordings, in order.
        hours: total length of the monitored recordings, h.
        recordings: names of them.
        silent: missing channels, by recording.
        traces: statistics and levels of residual groups, block by block.
        unlearned: sentences on residuals without output outside the range of the healthy logs, by recording.
        unlike: reason why a recording seems to be of another machine of the same type, by recording.
        outside: residual outside its healthy range, by recording without an alarm.
    """

    monitor: Monitor
    alarms: tuple[MonitorAlarm, ...]
    hours: float
    recordings: tuple[str, ...]
    silent: dict[str, tuple[str, ...]]
    traces: RunTraces
    unlearned: dict[str, tuple[str, ...]]
    unlike: dict[str, str]
    outside: dict[str, str]

    @property
    def silence(self) -> list[str]:
        """Sentences about changes that may be present without an alarm."""
        lines = [f"'{name}': no alarm, but {reason}" for name, reason in self.outside.items()]
        unseen = unseen_line(found_sizes(self.monitor.provenance))
        return [*lines, *([unseen] if unseen and not self.alarms else [])]

    @property
    def changes(self) -> list[list[MonitorAlarm]]:
        """Return alarms merged by `episodes`."""
        return episodes(self.alarms)

    def to_json(self) -> dict[str, object]:
        """Return the plain JSON values."""
        return {
            "hours": self.hours,
            "recordings": list(self.recordings),
            "silent": {name: list(channels) for name, channels in self.silent.items()},
            "unlearned": {name: list(reasons) for name, reasons in self.unlearned.items()},
            "unlike": dict(self.unlike),
            "outside": dict(self.outside),
            "silence": self.silence,
            "promise": self.monitor.limit.sentence(),
            "alarms": [alarm.to_json() for alarm in self.alarms],
        }


@dataclass(frozen=True, eq=False)
class WatchedRecording:
    """Findings of a monitor in one recording.

    Attributes:
        alarms: alarms in order of time.
        silent: channels that the recording lacks.
        unlearned: why residuals are silent.
        unlike: why the recording is not one of the machine of the monitor; empty if it is.
        outside: why a missing alarm says nothing; empty if it does.
        trace: trace for the page.
    """

    alarms: tuple[MonitorAlarm, ...]
    silent: tuple[str, ...]
    unlearned: tuple[str, ...]
    unlike: str
    outside: str
    trace: RecordingTrace


def run_monitor(
    folder: str | Path,
    source: DataSource,
    out: str | Path | None = None,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> MonitorRun:
    """Watch logs.

    Args:
        folder: folder of the monitor.
        source: the logs.
        out: run folder for the alarm log as JSON lines and as CSV, and for what `edp monitor report` shows.
        progress: receiver of the progress; its units are recordings.
        workers: who watches; nodes see monitor and run folder under the same paths. With a run folder a stopped call
            continues after the recordings that are done.

    Raises:
        EdpError: monitor or logs that cannot be used, or a file that cannot be written.
    """
    monitor = load_monitor(folder)
    if out is not None:
        check_claimable(out, "monitor run")
    recordings = source.read()
    for recording in recordings:
        monitor.check(recording)  # what is refused must not keep a corrected command out of the folder
    if out is None:
        return _watch_all(monitor, folder, recordings, None, progress, workers)
    origin = source.origin(recordings)
    key = run_key({"monitor": model_digest(folder)}, origin.digest or "")
    with Run.create(out, "monitor run", key) as opened:
        run = _watch_all(monitor, folder, recordings, opened.file(UNITS), progress, workers)
        provenance = new_provenance(origin).add_entries(monitor=str(folder))
        write_json(opened.file(PROVENANCE), provenance.to_table())
        _write(run, opened.path, str(folder))
    forget_units(opened.file(UNITS))
    return run


def _watch_all(
    monitor: Monitor,
    folder: str | Path,
    recordings: Sequence[Recording],
    units_folder: Path | None,
    progress: Progress,
    workers: Workers,
) -> MonitorRun:
    """Watch each recording as a unit of work."""
    digest = model_digest(folder)
    here = {"monitor": monitor} if workers.are_alone else {"folder": str(full_path(Path(folder)))}
    units = [
        WorkUnit(
            f"{__name__}:watch_unit", recording.name, {"monitor": digest, "name": recording.name}, recording.digest,
            {**here, "recording": recording},
        )
        for recording in recordings
    ]  # fmt: skip
    watching = progress.stage("recording", len(units))
    results = workers.map_in_order(units, watching, units_folder)
    watched = [unpack(result.content or b"", WatchedRecording) for result in results]
    names = tuple(recording.name for recording in recordings)
    pairs = list(zip(names, watched, strict=True))
    detectors = tuple(f"{name} {n + 1}" for n, name in enumerate(_detectors(monitor)))
    traces = RunTraces(monitor.block_s, detectors, tuple(groups_of(monitor)), tuple(one.trace for one in watched))
    hours = 0.0
    for recording in recordings:
        hours += recording.duration_s / 3600.0
    return MonitorRun(
        monitor,
        tuple(alarm for one in watched for alarm in one.alarms),
        hours,
        names,
        {name: one.silent for name, one in pairs if one.silent},
        traces,
        {name: one.unlearned for name, one in pairs if one.unlearned},
        {name: one.unlike for name, one in pairs if one.unlike},
        {name: one.outside for name, one in pairs if one.outside},
    )


def watch_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Watch the recording of a unit."""
    monitor = where["monitor"] if "monitor" in where else _open_monitor(where["folder"], identity.config["monitor"])
    return WithState({}, pack(watch_recording(monitor, where["recording"])))


@lru_cache(maxsize=1)
def _open_monitor(folder: str, digest: str) -> Monitor:
    """Return a monitor, loaded once for all units of a process; `digest` identifies its content."""
    return load_monitor(folder)


def watch_recording(monitor: Monitor, recording: Recording) -> WatchedRecording:
    """Run a monitor along a recording from its start."""
    silent = monitor.check(recording)
    start = str(recording.meta.get(START, ""))
    watched = monitor.watch(recording, start_time(start))
    outside = "" if watched.alarms else outside_line(monitor, watched.rows.astype(np.float64))
    return WatchedRecording(
        tuple(watched.alarms),
        silent,
        monitor.unlearned(recording),
        monitor.unlike(watched),
        outside,
        trace_of(monitor, recording, watched, groups_of(monitor), start),
    )


def _detectors(monitor: Monitor) -> list[str]:
    names = (type(watch.detector).__name__.removesuffix("Spec") for watch in monitor.chain.watches)
    return [re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower() for name in names]


def groups_of(monitor: Monitor) -> dict[str, list[int]]:
    """Return groups of residuals by source and kind of evaluated channels, with the positions of their summaries."""
    kinds = {channel.name: str(channel.kind).replace("_", " ") for channel in monitor.channels}
    groups: dict[str, list[int]] = {}
    for column, name in enumerate(monitor.summary_names):
        residual = name.rpartition(".")[0]
        source, _, judged = residual.partition(":")
        group = f"{source}: {kinds.get(judged, judged)}"
        groups.setdefault(group, []).append(column)
    return groups


def trace_of(
    monitor: Monitor, recording: Recording, watched: Watched, groups: Mapping[str, list[int]], start: str
) -> RecordingTrace:
    """Return the trace of a recording for the page."""
    rows = watched.rows.astype(np.float64)
    levels = np.full((len(rows), len(groups)), np.nan)
    for column, places in enumerate(groups.values()):
        part = rows[:, places]
        there = np.isfinite(part)
        counts = there.sum(axis=1)
        squares = np.where(there, part, 0.0) ** 2
        levels[:, column] = np.where(counts > 0, np.sqrt(squares.sum(axis=1) / np.maximum(counts, 1)), np.nan)
    silent = tuple(name for column, name in enumerate(groups) if np.isnan(levels[:, column]).all())
    ratios = (watched.statistics / monitor.chain.limit).astype(np.float32)
    return RecordingTrace(recording.name, start, recording.duration_s, ratios, levels.astype(np.float32), silent)


def _write(run: MonitorRun, folder: Path, monitor: str) -> None:
    """Write alarms, traces and their provenance."""
    dictionary = run.monitor.diagnosis
    write_alarms(run.alarms, folder / ALARM_LOG)
    write_traces(folder, run.traces)
    MonitorRunFile(
        monitor=monitor,
        promise=run.monitor.limit.sentence(),
        recordings=len(run.recordings),
        silent=run.silent,
        unlearned=run.unlearned,
        unlike=run.unlike,
        outside={name: f"no alarm, but {reason}" for name, reason in run.outside.items()},
        unseen=unseen_line(found_sizes(run.monitor.provenance)),
        classes=0 if dictionary is None else len(dictionary.classes),
        confusions=() if dictionary is None else dictionary.confusions,
        files=digests_of(folder, ALARM_LOG),
    ).write(folder)


def write_alarms(alarms: tuple[MonitorAlarm, ...], out: str | Path) -> tuple[Path, Path]:
    """Write alarms as JSON lines and as CSV; a file is whole or absent.

    Raises:
        StorageError: a file cannot be written.
    """
    path = Path(out)
    lines = "".join(json.dumps(alarm.to_json(), allow_nan=False) + "\n" for alarm in alarms)
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(COLUMNS)
    for alarm in alarms:
        plain = alarm.to_json()
        cause = plain["causes"][0] if plain["causes"] else {}
        plain["evidence"] = "; ".join(f"{name} {value:+.2f}" for name, value in alarm.evidence)
        # A sentence comes first, so that no cell of a spreadsheet begins with a sign that makes it a formula.
        writer.writerow([_cell(cause.get(name, plain.get(name, ""))) for name in COLUMNS])
    beside = path.with_suffix(".csv")
    write_bytes(path, lines.encode())
    write_bytes(beside, table.getvalue().encode())
    return path, beside


def _cell(value: Any) -> Any:
    """Return a cell that no spreadsheet evaluates as a formula."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return "'" + value
    return "" if value is None else value
