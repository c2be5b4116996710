"""What runs lie below a folder, as far as their files say: read within bounds, whatever is in them."""

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
from edp.storage.locks import held_by
from edp.storage.paths import entries_of, is_file_at, is_folder_at, is_link_at, status_of
from edp.storage.reading import parse_json, read_text, read_toml
from edp.storage.seals import unsealed
from edp.wording import figure

MOST_FOLDERS = 20_000
"""Folders that are looked into: more is a whole disk."""
DEEPEST = 6
"""Levels below the folder."""
_BYTES = 8 * 2**20
"""Of a file of a run; scores of hundreds of recordings take one."""
_LONGEST = 200
"""Characters of a text that is listed."""
_STUDY = "study.json"
_MARKS: Mapping[str, str] = {
    "twin/twin.json": "twin",
    "controller/controller.json": "control",
    "tuning.json": "tuning",
    _STUDY: "search",
    "auto.json": "auto",
    "foundation.json": "pretraining",
    "adaptation.json": "adaptation",
    "compression.json": "compression",
    "alarms.jsonl": "monitor run",
}
"""What only one kind of run has, in the order in which it decides."""
_HEADERS = ("bundle/bundle.json", "twin/twin.json", "controller/controller.json")
"""Of what a run made, with its arrays beside it."""
_WHOLE = ("search", "control", "compression", "monitor run")
"""Kinds of runs whose mark is written at their end, so that it makes them finished."""
_NETWORKS = ("network", "auto", "pretraining", "adaptation")
"""Kinds of runs that are finished by a bundle."""
_RUN = ("run.json", "status.json", "provenance.json", _STUDY, "auto.json")
"""One of these makes a folder a run."""


@dataclass(frozen=True)
class ListedRun:
    """A run on disk.

    Attributes:
        folder: where it is.
        kind: ``network`` or what `_MARKS` says; ``-`` for a folder that cannot be read.
        state: ``finished``, ``running``, ``stopped``, ``diverged``, or ``damaged`` where a file cannot be read, its
            settings are no TOML, or what it made is not there or not as it was written; ``cannot be read: REASON``
            for a folder that this process has no right to look into.
        when: of its last state, as its files say; else of its files.
        data: where its recordings were.
        score: its error on test logs in words; empty where it was not judged.
    """

    folder: Path
    kind: str
    state: str
    when: str
    data: str
    score: str


def list_runs(folder: str | Path) -> tuple[list[ListedRun], bool]:
    """The runs below a folder, the latest first, and whether all folders were looked into.

    Links are not followed. Files of a run that cannot be read make it ``damaged``, not the list.

    Raises:
        StorageError: there is no such folder.
    """
    top = Path(folder)
    if not is_folder_at(top):
        raise StorageError(f"no folder at '{top}'; give one that holds runs")
    runs, whole = [], True
    for number, path in enumerate(_folders(top)):
        if number >= MOST_FOLDERS:
            whole = False
            break
        try:
            if any(is_file_at(path / name) for name in _RUN):
                runs.append(_run(path))
            elif not os.access(path, os.R_OK | os.X_OK):
                runs.append(_unreadable(path, os.strerror(errno.EACCES)))
        except StorageError as error:
            runs.append(_unreadable(path, _reason(error)))
    return sorted(runs, key=lambda run: run.when, reverse=True), whole


def _folders(top: Path) -> Iterator[Path]:
    """A folder and those below it, but none within a run: its parts are not runs of their own."""
    waiting = [(top, 0)]
    while waiting:
        path, depth = waiting.pop()
        yield path
        try:
            if depth == DEEPEST or is_file_at(path / "run.json"):
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


def _run(path: Path) -> ListedRun:
    kind = next((kind for mark, kind in _MARKS.items() if is_file_at(path / mark)), "network")
    damaged: list[str] = []
    status, provenance, scores = (_part(path / f"{name}.json", damaged) for name in ("status", "provenance", "scores"))
    # Before its result is there, a run has only what its status says.
    kind = str(status.get("kind", kind)) if kind == "network" and status.get("kind") in _MARKS.values() else kind
    state = str(status.get("status", ""))
    if state not in ("finished", "diverged"):
        state = "running" if held_by(path / ".lock") else "finished" if kind in _WHOLE else "stopped"
    data = provenance.get("data")
    source = str(data.get("source", "")) if isinstance(data, dict) else ""
    when = str(status.get("time") or provenance.get("created") or _touched(path))
    score = ""
    try:
        score = _score(scores)
    except (KeyError, TypeError, ValueError, AttributeError):
        damaged.append("scores.json")
    damaged += _damaged_parts(path, kind if state == "finished" else "")
    return ListedRun(path, kind, "damaged" if damaged else state, when[:_LONGEST], source[:_LONGEST], score[:_LONGEST])


def _damaged_parts(path: Path, finished: str) -> list[str]:
    """Settings and results of a run that are damaged; of a finished one of that kind, also a result that is missing."""
    damaged = []
    try:
        if is_file_at(path / "config.toml"):
            read_toml(path / "config.toml")
    except StorageError:
        damaged.append("config.toml")
    for name in _HEADERS:
        file = path / name
        try:
            missing = name == _HEADERS[0] and finished in _NETWORKS
            damaged += [name] if (not is_whole(file) if is_file_at(file) else missing) else []
        except (StorageError, ValueError):
            damaged.append(name)
    return damaged


def _part(file: Path, damaged: list[str]) -> Mapping[str, Any]:
    """A JSON file of a run; empty where there is none or it is damaged."""
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


def _touched(path: Path) -> str:
    """When a folder was last written, in the form of the files."""
    try:
        return time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(status_of(path).st_mtime))
    except (StorageError, OverflowError, ValueError):
        return ""


def _score(scores: Mapping[str, Any]) -> str:
    """The network's root-mean-square error at the longest horizon, of the first output where they have no one unit."""
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
    return f"{figure(error)}{of_unit} at k = {horizon}{more}"
