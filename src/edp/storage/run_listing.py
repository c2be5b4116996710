"""Listing of runs below a folder, with bounds on the size of every file that is read."""

from __future__ import annotations

import errno
import math
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.storage.headers import is_whole
from edp.storage.locks import find_holder
from edp.storage.paths import entries_of, is_file_at, is_folder_at, is_link_at, status_of
from edp.storage.provenance import PROVENANCE
from edp.storage.reading import parse_json, read_text, read_toml
from edp.storage.run_kinds import BUNDLE, CONTROLLER, RUN_KINDS, TWIN, RunKind
from edp.storage.runs import ENDED, FINISHED, IDENTITY, STATUS
from edp.storage.seals import unsealed
from edp.wording import typed

MAX_FOLDERS = 20_000
"""Maximum number of searched folders. A larger tree is probably a whole disk."""
DEEPEST = 6
"""Maximum number of folder levels below the searched folder."""
_BYTES = 8 * 2**20
"""Maximum size of a run's file in bytes. The scores of hundreds of recordings take 1 MB."""
_LONGEST = 200
"""Maximum number of characters of a text in the listing."""
MODELS = (BUNDLE, TWIN, CONTROLLER)


@dataclass(frozen=True)
class ListedRun:
    """A run on disk.

    Attributes:
        folder: folder of the run.
        kind: name of its kind, see `edp.storage.run_kinds`; ``-`` for a folder that cannot be read.
        state: ``finished``, ``running``, ``stopped``, ``diverged``, or ``damaged`` where a file cannot be read, its
            settings are no TOML, or what it made is not there or not as it was written; ``cannot be read: REASON``
            for a folder that this process has no right to look into.
        when: time of its last state according to its files, otherwise time of its files.
        data: source of its recordings.
        score: error on the test logs as text; empty if the run was not evaluated.
    """

    folder: Path
    kind: str
    state: str
    when: str
    data: str
    score: str


def list_runs(folder: str | Path) -> tuple[list[ListedRun], bool]:
    """Return the runs below a folder, the latest first, and whether all folders could be read.

    Links are not followed. Files of a run that cannot be read make it ``damaged``, not the list.

    Raises:
        StorageError: there is no such folder.
    """
    top = Path(folder)
    if not is_folder_at(top):
        raise StorageError(f"no folder at '{top}'; give one that holds runs")
    runs, whole = [], True
    for number, path in enumerate(_folders(top)):
        if number >= MAX_FOLDERS:
            whole = False
            break
        try:
            if _is_run(path):
                runs.append(_run(path))
            elif not os.access(path, os.R_OK | os.X_OK):
                runs.append(_unreadable(path, os.strerror(errno.EACCES)))
        except StorageError as error:
            runs.append(_unreadable(path, _reason(error)))
    return sorted(runs, key=lambda run: run.when, reverse=True), whole


def _folders(top: Path) -> Iterator[Path]:
    """Yield a folder and its subfolders, except those inside runs."""
    waiting = [(top, 0)]
    while waiting:
        path, depth = waiting.pop()
        yield path
        try:
            if depth == DEEPEST or is_file_at(path / IDENTITY):
                continue
            below = [e for e in entries_of(path) if e.name[:1] != "." and is_folder_at(e) and not is_link_at(e)]
        except StorageError:  # listed as a folder that cannot be read
            continue
        waiting += [(entry, depth + 1) for entry in reversed(below)]


def _reason(error: StorageError) -> str:
    cause = error.__cause__
    return (cause.strerror if isinstance(cause, OSError) else None) or str(error)


def _unreadable(path: Path, reason: str) -> ListedRun:
    """Return the row of a folder that cannot be looked into."""
    return ListedRun(path, "-", f"cannot be read: {reason.lower()}"[:_LONGEST], "", "", "")


def _is_run(path: Path) -> bool:
    started = (IDENTITY, STATUS, PROVENANCE)
    return any(is_file_at(path / name) for name in (*started, *(kind.result for kind in RUN_KINDS.values())))


def _run(path: Path) -> ListedRun:
    damaged: list[str] = []
    identity, status, provenance, scores = (
        _part(path / name, damaged) for name in (IDENTITY, STATUS, PROVENANCE, "scores.json")
    )
    kind = _kind(path, identity, status)
    data = provenance.get("data")
    source = str(data.get("source", "")) if isinstance(data, dict) else ""
    when = str(status.get("time") or provenance.get("created") or _last_change(path))
    score = ""
    try:
        score = _score(scores)
    except (KeyError, TypeError, ValueError, AttributeError):
        damaged.append("scores.json")
    state = _state(path, kind, status)
    damaged += _list_damaged(path, kind if state == FINISHED else None)
    return ListedRun(
        path, kind.name, "damaged" if damaged else state, when[:_LONGEST], source[:_LONGEST], score[:_LONGEST]
    )


def _kind(path: Path, identity: Mapping[str, object], status: Mapping[str, object]) -> RunKind:
    """Return the kind that a run states; runs of earlier versions are recognised by their result."""
    stated = RUN_KINDS.get(str(identity.get("kind") or status.get("kind")))
    results = (kind for kind in RUN_KINDS.values() if is_file_at(path / kind.result))
    return stated or next(results, RUN_KINDS["network"])


def _state(path: Path, kind: RunKind, status: Mapping[str, object]) -> str:
    """Return the state of a run; a state that is not recorded follows from the result, which is written at the end."""
    if find_holder(path / kind.lock):
        return "running"
    recorded = status.get("status") or _study_state(path, kind)
    if not recorded:
        return FINISHED if is_file_at(path / kind.result) else "stopped"
    return recorded if recorded in ENDED else "stopped"


def _study_state(path: Path, kind: RunKind) -> str:
    if kind.name != "search":
        return ""
    # The file of a study is read within bounds; `edp search report` checks all of it.
    return str(_part(path / kind.result, []).get("state", ""))


def _list_damaged(path: Path, finished: RunKind | None) -> list[str]:
    """Return the settings and models of a run that are damaged, and the model that a finished run lacks."""
    damaged = []
    try:
        if is_file_at(path / "config.toml"):
            read_toml(path / "config.toml")
    except StorageError:
        damaged.append("config.toml")
    for name in MODELS:
        file = path / name
        try:
            missing = finished is not None and name == finished.model
            damaged += [name] if (not is_whole(file) if is_file_at(file) else missing) else []
        except (StorageError, ValueError):
            damaged.append(name)
    return damaged


def _part(file: Path, damaged: list[str]) -> Mapping[str, object]:
    """Read a JSON file of a run; empty if it is missing or damaged."""
    if not is_file_at(file):
        return {}
    try:
        content = parse_json(read_text(file, _BYTES), f"'{file}'", finite=False)
        content = unsealed(content, f"'{file}'", StorageError)
    except (StorageError, ValueError):  # also a number that is not finite, under a hash
        content = None
    if not isinstance(content, dict):
        damaged.append(file.name)
        return {}
    return content


def _last_change(path: Path) -> str:
    """Return the time of the last change of a folder, in the form of the files."""
    try:
        return time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(status_of(path).st_mtime))
    except (StorageError, OverflowError, ValueError):
        return ""


def _score(scores: Mapping[str, Any]) -> str:
    """Return the network's RMSE at the longest horizon; for the first output if units differ."""
    if not scores:
        return ""
    horizon = max(int(one) for one in scores["task"]["horizons"])
    targets = scores["targets"]
    units = {str(target["unit"]) for target in targets}
    shared = len(targets) == 1 or (len(units) == 1 and units != {"1"})
    name = "mean" if shared else str(targets[0]["name"])
    error = float(scores["models"]["network"]["overall"][str(horizon)][name]["rmse"])
    if not math.isfinite(error):
        return ""
    unit = str(targets[0]["unit"])
    of_unit = "" if unit == "1" else f" {unit}"
    more = "" if shared else f" ({name}; {len(targets)} outputs)"
    return f"{typed(error)}{of_unit} at k = {horizon}{more}"
