"""A monitor along logs: alarms as JSON lines and as CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edp.logs.source import DataSource
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.monitor import Monitor
from edp.monitor.monitor_file import load_monitor
from edp.storage import write_bytes

COLUMNS = (
    *("recording", "raised_s", "since_s", "severity", "sentence", "detector", "statistic", "limit"),
    *("kind", "site", "size", "unit", "probability", "index", "evidence"),
)
"""Of the CSV file; of the causes the most probable one."""


@dataclass(frozen=True, eq=False)
class MonitorRun:
    """What came of a monitor along logs.

    Attributes:
        monitor: that ran.
        alarms: of all recordings, in order.
        hours: that it watched.
        recordings: names of them.
        silent: by recording, channels that it lacks.
    """

    monitor: Monitor
    alarms: tuple[MonitorAlarm, ...]
    hours: float
    recordings: tuple[str, ...]
    silent: dict[str, tuple[str, ...]]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "hours": self.hours,
            "recordings": list(self.recordings),
            "silent": {name: list(channels) for name, channels in self.silent.items()},
            "promise": self.monitor.limit.sentence(),
            "alarms": [alarm.to_json() for alarm in self.alarms],
        }


def run_monitor(
    folder: str | Path,
    source: DataSource,
    out: str | Path | None = None,
    on_recording: Callable[[str, int, int], None] | None = None,
) -> MonitorRun:
    """Watch logs.

    Args:
        folder: of the monitor.
        source: the logs.
        out: file for the alarm log: JSON lines, and beside it a CSV file of the same name.
        on_recording: called with the name of the recording that begins, how many are done, and how many there are.

    Raises:
        EdpError: monitor or logs that cannot be used, or a file that cannot be written.
    """
    monitor, alarms, silent, hours, names = load_monitor(folder), [], {}, 0.0, []
    recordings = source.read()
    for done, recording in enumerate(recordings):
        if on_recording is not None:
            on_recording(recording.name, done, len(recordings))
        lacking = monitor.check(recording)
        if lacking:
            silent[recording.name] = lacking
        alarms += monitor.run(recording)
        hours += recording.duration_s / 3600.0
        names.append(recording.name)
    run = MonitorRun(monitor, tuple(alarms), hours, tuple(names), silent)
    if out is not None:
        write_alarms(run.alarms, out)
    return run


def write_alarms(alarms: tuple[MonitorAlarm, ...], out: str | Path) -> tuple[Path, Path]:
    """Write alarms as JSON lines, and as CSV beside them; each file is whole or not there.

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
    """A cell that no spreadsheet takes for a formula."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return "'" + value
    return "" if value is None else value
