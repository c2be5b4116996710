"""Writing a recording, whole or not at all."""

from __future__ import annotations

from pathlib import Path

from edp.errors import DataError
from edp.logs.detect import format_for
from edp.logs.raw import WriteOptions
from edp.recording import Recording
from edp.storage import replacing


def write_recording(recording: Recording, path: str | Path, options: WriteOptions | None = None) -> Path:
    """Write a recording; the ending of `path` chooses the format, values are written in SI units.

    Args:
        recording: what to write.
        path: ``.csv``, ``.parquet`` or ``.mat``; an existing file is replaced only by a complete new one.
        options: the layout of a MAT file.

    Raises:
        DataError: unknown ending, nothing to write, or names the format cannot hold.
        StorageError: disk full or read-only folder; an existing file is left as it was.
    """
    target = Path(path)
    chosen = format_for(target)
    if recording.samples == 0 or not recording.channels:
        raise DataError(f"recording '{recording.name}' is empty; nothing is written to '{target}'")
    with replacing(target) as temporary:
        chosen.write(recording, temporary, options or WriteOptions())
    return target
