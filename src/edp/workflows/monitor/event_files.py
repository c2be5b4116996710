"""Logs as MDF 4 with the alarms of a monitor as events, for measurement tools."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from edp.export.escape import distinct
from edp.logs import LogEvent, write_with_events
from edp.monitor.alarms import MonitorAlarm
from edp.recording import Recording
from edp.storage import make_folder

LONGEST_NAME = 100
"""Maximum length of a file name without its ending."""


def write_event_files(
    alarms: Sequence[MonitorAlarm], recordings: Sequence[Recording], folder: str | Path
) -> list[Path]:
    """Write every recording as MDF 4 with its alarms as segments from onset to the detecting block.

    Args:
        alarms: alarms by recording name.
        recordings: recordings with the channels to write.
        folder: made when absent; files of the same names are replaced.

    Raises:
        DataError: the package asammdf is missing.
        StorageError: the folder cannot be written.
    """
    target = make_folder(folder)
    # Names come from logs: no path out of the folder, and equal ones get numbers.
    names = distinct((re.sub(r"[^\w.-]|^\.+", "_", r.name, flags=re.ASCII) for r in recordings), LONGEST_NAME)
    files = []
    for name, recording in zip(names, recordings, strict=True):
        events = [_event(alarm) for alarm in alarms if alarm.recording == recording.name]
        files.append(write_with_events(recording, target / f"{name}.mf4", events))
    return files


def _event(alarm: MonitorAlarm) -> LogEvent:
    what = f"{alarm.causes[0].kind} {alarm.causes[0].site}" if alarm.causes else alarm.evidence[0][0]
    return LogEvent(f"{alarm.severity}: {what}", alarm.since_s, alarm.raised_s, alarm.sentence)
