"""What the workflows read again and again is read once: logs by their content, in tests whose subject is another.

Each reading of a log forks a process of the sandbox, 0.04 s of processor time; a small study reads its six logs
dozens of times. `DataSource.read` alone is served from here: `edp.logs.read_recording` reads whenever it is called, and
child processes read by themselves.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

FRESH = ("security/", "fuzz/", "unit/test_logs_", "unit/test_front_door", "unit/api/", "examples/")
"""Begins of the places of tests that are about reading: there nothing is kept, nor taken."""
MOST = 64
"""Recordings that are kept."""
MOST_BYTES = 1 << 20
"""Of the numbers of one that is kept."""
_kept: OrderedDict[tuple[object, ...], Any] = OrderedDict()
_on: list[bool] = [False]


def begin(place: str) -> None:
    """A test begins; `place` is its file below ``tests``."""
    _on[0] = not place.startswith(FRESH)
    _install()


@cache
def _install() -> None:
    """Put the memory between the workflows and the reading of a log; in workers, not in what controls them."""
    from edp.logs import read, source

    read.read_recording = source.read_recording = _remembering(read.read_recording)


def _remembering(plain: Callable[..., Any]) -> Callable[..., Any]:
    def read_recording(path: str | Path, signal_map: Any = None, **options: Any) -> Any:
        # The log of a bag is a folder; it is read as it is.
        if not _on[0] or not Path(path).is_file():
            return plain(path, signal_map, **options)
        content = hashlib.sha256(Path(path).read_bytes()).digest()
        key = (str(path), content, repr(signal_map), repr(sorted(options.items())))
        recording = _kept.pop(key, None)
        if recording is None:
            recording = plain(path, signal_map, **options)
        if recording.values.nbytes <= MOST_BYTES:
            _kept[key] = recording
            if len(_kept) > MOST:
                _kept.popitem(last=False)
        # A copy, so that what a test does to its numbers stays there.
        return replace(recording, values=recording.values.copy(), meta=dict(recording.meta))

    return read_recording
