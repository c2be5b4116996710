"""Writing a recording, whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from edp.errors import DataError
from edp.logs.detect import format_for
from edp.logs.formats.base import TRUTH, LogFormat, WriteOptions, holds_truth_apart, parted
from edp.logs.formats.mdf import MdfFormat
from edp.logs.formats.mdf_events import LogEvent
from edp.recording import Recording
from edp.storage import replacing


def write_recording(recording: Recording, path: str | Path, options: WriteOptions | None = None) -> Path:
    """Write a recording; the ending of `path` chooses the format, values are written in SI units.

    Args:
        recording: recording to write.
        path: path of the file; its ending is in `edp.logs.list_suffixes`. An existing file is replaced only by a
            complete new one.
        options: the layout of a MAT file; where truth goes.

    Raises:
        DataError: unknown ending, nothing to write, or names the format cannot hold.
        StorageError: disk full or read-only folder; an existing file is left as it was.
    """
    target = Path(path)
    chosen = format_for(target)
    if recording.samples == 0 or not recording.channels:
        raise DataError(f"recording '{recording.name}' is empty; nothing is written to '{target}'")
    options = options or WriteOptions()
    if options.truth == "with":
        return _write(chosen, recording, target, options)
    measured, truth = parted(recording)
    if measured is None:
        raise DataError(
            f"recording '{recording.name}' holds no channel but truth; nothing would be left for '{target}': "
            "write it with the truth"
        )
    if truth is None or options.truth == "without":
        return _write(chosen, measured, target, replace(options, truth="without"))
    if holds_truth_apart(chosen):
        return _write(chosen, recording, target, options)
    # The log last: where it lies, its truth lies beside it.
    _write(chosen, truth, truth_path(target), options)
    return _write(chosen, measured, target, options)


def write_with_events(recording: Recording, path: str | Path, events: Sequence[LogEvent]) -> Path:
    """Write a recording as MDF 4 with events, which measurement tools mark along its signals.

    Args:
        recording: recording to write.
        path: an existing file is replaced only by a complete new one.
        events: events, at most `edp.logs.formats.mdf_events.MAX_EVENTS`.

    Raises:
        DataError: an ending other than MDF's, nothing to write, too many events, or the package asammdf is missing.
        StorageError: disk full or read-only folder; an existing file is left as it was.
    """
    target = Path(path)
    if target.suffix.lower() not in MdfFormat.suffixes:
        raise DataError(f"'{target}' takes no events; MDF 4 does: choose an ending of {', '.join(MdfFormat.suffixes)}")
    if recording.samples == 0 or not recording.channels:
        raise DataError(f"recording '{recording.name}' is empty; nothing is written to '{target}'")
    with replacing(target) as temporary:
        MdfFormat().write_with_events(recording, temporary, events)
    return target


def _write(chosen: LogFormat, recording: Recording, target: Path, options: WriteOptions) -> Path:
    with replacing(target) as temporary:
        chosen.write(recording, temporary, options)
    return target


def truth_path(path: str | Path) -> Path:
    """Return the path of the ground truth file of a log, for formats without a place for it."""
    log = Path(path)
    return log.with_name(f"{log.stem}.{TRUTH}{log.suffix}")
