"""Sessions for a search that was given too few logs: consecutive parts of each log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import tomli_w

from edp.config.experiment import plain_tree
from edp.logs.read import unique_names
from edp.logs.source import DataSource, Log
from edp.recording import Recording
from edp.storage.paths import full_path

SESSIONS_FILE = "sessions.toml"
_SESSIONS = 12
"""Parts that a search gets at least: two test sessions, one for phase 6, and nine in at most five folds."""
_MIN_GAPS = 4
"""Length of a part at least, in gaps (window plus largest horizon)."""


@dataclass(frozen=True)
class LogParts:
    """Logs that were divided into sessions.

    Attributes:
        logs: one entry per session.
        recordings: the sessions as they are read.
        seconds: length of the shortest session.
    """

    logs: tuple[Log, ...]
    recordings: list[Recording]
    seconds: float

    def data_set(self) -> str:
        """Return the text of a data-set file that lists the sessions."""
        header = "# Sessions of this search: parts of the logs, since there were too few logs.\n"
        return header + tomli_w.dumps({"recordings": [_entry(log) for log in self.logs]})


def divide_logs(source: DataSource, recordings: Sequence[Recording], gap: int) -> LogParts | None:
    """Divide each log into parts of about equal length, each a session; `gap` samples are left out between them.

    Args:
        source: logs or a data-set file; a store cannot be divided.
        recordings: the recordings of the source.
        gap: samples between parts, and the unit of their least length.

    Returns:
        the sessions; None where the logs cannot be listed in a file, or are too short.

    Raises:
        DataError: a part of a log that cannot be used by itself.
    """
    logs = source.logs()
    if len(logs) != len(recordings) or any("$" in str(log.path) or log.remote is not None for log in logs):
        return None
    length = sum(recording.samples for recording in recordings) / _SESSIONS
    parts: list[Log] = []
    for log, recording in zip(logs, recordings, strict=True):
        count = max(1, math.ceil(recording.samples / length - 1e-9))
        edges = [round(i * recording.samples / count) for i in range(count + 1)]
        first = log.rows[0] if log.rows else 0
        for number, (start, stop) in enumerate(pairwise(edges), start=1):
            stop -= 0 if number == count else gap
            if stop - start < _MIN_GAPS * gap:
                return None
            rows = (first + start, first + stop)
            parts.append(replace(log, path=full_path(log.path), name=f"{recording.name}_{number}", rows=rows))
    names = unique_names([str(log.name) for log in parts], [log.path for log in parts])
    named = tuple(replace(log, name=name) for log, name in zip(parts, names, strict=True))
    read = [log.read() for log in named]
    return LogParts(named, read, min(recording.duration_s for recording in read))


def _entry(log: Log) -> dict[str, object]:
    """Return a log as an entry of a data-set file."""
    entry: dict[str, object] = {"path": str(log.path), "name": log.name, "rows": list(log.rows or ())}
    if log.signal_map is not None:
        entry["map"] = plain_tree(log.signal_map)
    if log.repair is not None:
        entry["repair"] = plain_tree(log.repair)
    if log.machine:
        entry["machine"] = log.machine
    return entry
