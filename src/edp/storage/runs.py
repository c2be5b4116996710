"""Run folders: everything needed to repeat a training and to go on with it after a stop."""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

from edp import __version__
from edp.errors import BusyError, StorageError
from edp.storage.folders import check_kind
from edp.storage.locks import check_held, held_by, hold
from edp.storage.paths import entries_of, is_file_at, is_folder_at, is_there
from edp.storage.reading import object_with, read_object
from edp.storage.seals import sealed_line
from edp.storage.writing import make_folder, remove_unfinished, write_bytes, write_json

RECORDED = ("torch", "numpy", "scipy", "numba", "scikit-learn", "safetensors")
"""Libraries whose versions can change a result."""
IDENTITY, STATUS = "run.json", "status.json"
ENDED = ("finished", "diverged")
"""States in which a run stays."""
LEFT = (".lock", "config.toml")
"""What a run that was killed before it was bound to its folder leaves there."""
PARTS = "parts"
"""Folder of a run in which its single trainings stand, where it has several."""


def environment(threads: int) -> dict[str, str]:
    """Versions and machine facts that can change a result; flat strings."""
    facts = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for name in RECORDED:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            # Also a fact: without a library another way may be taken.
            facts[name] = "absent"
    # The number of threads changes the order of sums, and so their last bits.
    return facts | {"threads": str(threads)}


def run_key(config: Mapping[str, Any], data_digest: str) -> str:
    """Content address of a run: equal settings, data and code version give an equal key."""
    plain = {"config": config, "data": data_digest, "edp": __version__}
    text = json.dumps(plain, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


class RunFolder:
    """A folder that holds one run; locked while a process writes to it.

    Args:
        path: the folder; made when absent.

    Raises:
        BusyError: another process holds it.
        StorageError: the folder cannot be made, or is one of another kind, such as a store.
    """

    def __init__(self, path: str | Path) -> None:
        check_claimable(path)
        self.path = make_folder(path)
        try:
            self._lock = hold(self.path / ".lock")
        except BusyError as error:
            raise _busy(self.path, str(error).rpartition("process ")[2]) from None
        remove_unfinished(self.path)

    def __enter__(self) -> RunFolder:
        """The folder itself; leaving the block frees the lock."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free the lock."""
        self._lock.close()

    def file(self, name: str) -> Path:
        """Path of a file in the folder."""
        return self.path / name

    def claim(self, key: str, config_text: str) -> bool:
        """Bind the folder to a run; True when the same run was begun here before and can go on.

        Raises:
            StorageError: the folder holds a run with other settings, data or code version.
        """
        identity = self.file(IDENTITY)
        if is_there(identity):
            stored_identity = read_object(identity, ("key",))
            if stored_identity["key"] != key:
                raise StorageError(
                    f"run folder '{self.path}' holds another run (other settings, data or version); nothing was "
                    "changed. Choose another folder, or remove this one"
                )
            return True
        # Settings before the identity: a kill between the two leaves a folder that is not bound yet.
        write_bytes(self.file("config.toml"), config_text.encode())
        write_json(identity, {"schema": 1, "key": key, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z")})
        return False

    def write_status(self, status: str, **facts: Any) -> None:
        """Say where the run stands: ``running``, ``finished`` or ``diverged``, with facts that fit into JSON."""
        check_held(self.file(".lock"), self._lock)
        write_json(self.file(STATUS), {"status": status, "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **facts})

    def status(self) -> dict[str, Any]:
        """Where the run stands; empty where nothing was written yet."""
        status_file = self.file(STATUS)
        return read_object(status_file, ("status", "time")) if is_there(status_file) else {}

    def remove_parts(self) -> None:
        """Delete the folders of its single trainings, which only an unfinished run reads."""
        # Not through a link: what it points to is not ours.
        shutil.rmtree(self.path / PARTS, ignore_errors=True)

    def write_history(self, rows: list[dict[str, Any]]) -> None:
        """Write one line of JSON with a hash for each epoch."""
        check_held(self.file(".lock"), self._lock)
        write_bytes(self.file("history.jsonl"), "".join(map(sealed_line, rows)).encode())


def unfinished_text(folder: str | Path) -> str:
    """Return the message about an unfinished run; an empty text if the folder has no unfinished run.

    Every command that opens a run and misses the result says this.

    Raises:
        StorageError: the status of the run is damaged.
    """
    path = Path(folder)
    started = is_file_at(path / IDENTITY) or all(is_file_at(path / name) for name in LEFT)
    status = read_object(path / STATUS, ("status",)) if is_file_at(path / STATUS) else {}
    if not started or status.get("status") in ENDED:
        return ""
    holder = held_by(path / ".lock")
    state = "it was stopped" if holder is None else f"process {holder} is at work"
    todo = "give the command that began it again to continue" if holder is None else "wait until it ends"
    return f"'{path}' holds a run that is not finished ({state}); {todo}"


def check_claimable(path: str | Path) -> None:
    """Refuse a folder that `RunFolder` would refuse; call it before logs are read or anything is computed.

    Nothing is made or changed: a command that is refused later leaves no folder.

    Raises:
        BusyError: another process holds it.
        StorageError: it is a folder of another kind, such as a store.
    """
    check_kind(path, "run", "study", "fleet", what="a run")
    holder = held_by(Path(path) / ".lock")
    if holder is not None:
        raise _busy(Path(path), holder)


def _busy(path: Path, holder: str) -> BusyError:
    return BusyError(f"run folder '{path}' is in use by process {holder}; wait for it or choose another folder")


def check_free(path: str | Path, what: str) -> None:
    """Refuse a folder in which a new run would lie among the files of something else.

    Args:
        path: of a run folder to be: absent, empty, that of a run, or what a killed run left.
        what: the command, for the message.

    Raises:
        StorageError: it is a file, or holds something and no run.
    """
    folder = Path(path)
    if not is_there(folder) or is_file_at(folder / IDENTITY):
        return
    if not is_folder_at(folder):
        raise StorageError(f"'{folder}' is a file; {what} writes a folder: choose another name")
    others = sorted(entry.name for entry in entries_of(folder) if entry.name not in LEFT)
    if others:
        raise StorageError(
            f"folder '{folder}' is not empty and holds no run ('{others[0][:60]}'); nothing was changed. Choose a new "
            f"or empty folder for {what}"
        )


@dataclass(frozen=True)
class KeyedRun:
    """A run folder with the key of the training in it, by which its checkpoints are known.

    Attributes:
        folder: where the training writes.
        key: of the training, see `run_key`.
    """

    folder: RunFolder
    key: str


@contextmanager
def part_of(run: KeyedRun | None, name: str) -> Iterator[KeyedRun | None]:
    """A folder in that of a run, for one of several trainings of it, locked while it is open; the run itself where
    `name` is empty, None without one.
    """
    if run is None or not name:
        yield run
        return
    with RunFolder(run.folder.path / PARTS / name) as folder:
        yield KeyedRun(folder, run.key)


def read_provenance(folder: str | Path) -> dict[str, Any]:
    """Where a run comes from, with all that the commands on a trained run need of it.

    Raises:
        StorageError: not a run folder, or its provenance is damaged.
    """
    file = Path(folder) / "provenance.json"
    if not is_file_at(file):
        raise StorageError(
            unfinished_text(folder)
            or f"'{folder}' is not a run folder: it has no {file.name}; give the folder of edp train"
        )
    provenance = read_object(file, ("data", "seconds"))
    data = object_with(provenance["data"], ("source", "reader", "digest"), f"'{file}', data,")
    reader = object_with(data["reader"], ("path",), f"'{file}', data.reader,")
    texts = {"data.reader.path": reader["path"], "data.digest": data["digest"], "data.source": data["source"]}
    wrong = [name for name, value in texts.items() if not isinstance(value, str)]
    wrong += [] if isinstance(provenance["seconds"], int | float) else ["seconds"]
    if wrong:
        raise StorageError(f"'{file}' is damaged: {', '.join(wrong)} is of another kind; restore it or train again")
    return provenance


def command_line() -> str:
    """The command as a user would type it."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
