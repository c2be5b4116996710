"""Run folders: everything needed to repeat a training, and to continue it after a stop."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from edp import __version__
from edp.errors import BusyError, ConfigError, EdpError, StorageError
from edp.storage.folders import check_kind
from edp.storage.locks import check_held, find_holder, hold
from edp.storage.paths import entries_of, files_below, full_path, is_file_at, is_folder_at, is_link_at, is_there
from edp.storage.reading import read_object
from edp.storage.run_kinds import RUN_KINDS, RunKind
from edp.storage.seals import seal_line
from edp.storage.writing import TEMPORARY, make_folder, remove_unfinished, write_bytes, write_json

IDENTITY, STATUS = "run.json", "status.json"
FINISHED = "finished"
ENDED = (FINISHED, "diverged")
"""Final states of a run."""
LEFT = (".lock", "config.toml")
"""Files that remain in the folder of a run whose process was killed before it wrote the identity file."""
PARTS = "parts"
"""Subfolder for the individual trainings of a run that has several."""


def run_key(config: Mapping[str, object], data_digest: str) -> str:
    """Return content address of a run: equal settings, data and code version give an equal key."""
    plain = {"config": config, "data": data_digest, "edp": __version__}
    text = json.dumps(plain, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


class Run:
    """A folder that holds one run; locked while a process writes to it.

    Args:
        path: the folder; made when absent.
        kind: name of the kind of run, see `edp.storage.run_kinds`.

    Attributes:
        path: the folder.
        kind: name of the kind of run.
        key: content address of the run, see `run_key`; empty before `claim`.
        is_finished: whether the run was finished before it was opened by `create`.

    Raises:
        BusyError: another process holds it.
        StorageError: the folder cannot be made, or is one of another kind, such as a store.
    """

    def __init__(self, path: str | Path, kind: str = "network") -> None:
        check_claimable(path, kind)
        self.path, self.kind, self.key, self.is_finished = make_folder(path), RUN_KINDS[kind].name, "", False
        try:
            self._lock = hold(self.path / ".lock")
        except BusyError as error:
            raise _busy(self.path, str(error).rpartition("process ")[2]) from None
        remove_unfinished(self.path)

    @classmethod
    @contextmanager
    def create(cls, path: str | Path | Run, kind: str, key: str, settings: str = "") -> Iterator[Run]:
        """Open the folder of a new or stopped run for writing, and record the state of the run.

        The state is ``running`` inside the block and ``finished`` after it. A block that raises leaves ``running``,
        which readers show as stopped as soon as no process holds the folder; `write_status` in the block replaces it.
        A new run that is refused (`EdpError`) before it has written anything leaves the folder as it was, so that the
        corrected command can have it.
        The state of a run that ended before does not become ``running``.

        Args:
            path: the folder, made when absent; or a run that the caller has opened. The caller then closes the run and
                records its end, and its kind is the one of the run.
            kind: name of the kind of run, see `edp.storage.run_kinds`.
            key: see `run_key`.
            settings: settings of the run, as TOML; empty for a run without settings.

        Raises:
            BusyError: another process holds the folder.
            StorageError: the folder holds another run, or something else.
        """
        with nullcontext(path) if isinstance(path, Run) else cls(path, kind) as run:
            is_new = not run.claim(key, settings)
            status = run.status().get("status")
            run.is_finished = status == FINISHED
            if status not in ENDED:
                run.write_status("running")
            try:
                yield run
            except EdpError:
                if is_new and run.status().get("status") not in ENDED:
                    run.release()
                raise
            if run is not path:
                run.finish()

    def __enter__(self) -> Run:
        """Return the run; leaving the block releases the lock."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the lock."""
        self._lock.close()

    def file(self, name: str) -> Path:
        """Return the path of a file in the folder."""
        return self.path / name

    def claim(self, key: str, settings: str) -> bool:
        """Bind the folder to a run; return True if the same run was begun here before and can continue.

        Raises:
            StorageError: the folder holds a run with other settings, data or code version.
        """
        identity, self.key = self.file(IDENTITY), key
        if is_there(identity):
            stored_identity = read_object(identity, ("key",))
            if stored_identity["key"] != key:
                raise StorageError(
                    f"run folder '{self.path}' holds another run (other settings, data or version); nothing was "
                    "changed. Choose another folder, or remove this one"
                )
            return True
        # Settings before the identity: a kill between the two leaves a folder that is not bound yet.
        if settings:
            self.write_settings(settings)
        created = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        write_json(identity, {"schema": 1, "key": key, "kind": self.kind, "created": created})
        return False

    def release(self) -> None:
        """Release the folder of a run that has written only its identity, settings, state and empty folders."""
        own = {*LEFT, IDENTITY, STATUS}
        if {file.name for file in files_below(self.path)} <= own:
            for entry in entries_of(self.path):
                if is_folder_at(entry) and not is_link_at(entry):
                    shutil.rmtree(entry, ignore_errors=True)
            # The identity last: a kill in between leaves the folder of a run, not of something else.
            for name in (STATUS, "config.toml", IDENTITY):
                self.file(name).unlink(missing_ok=True)

    def write_settings(self, settings: str) -> None:
        """Write the settings of the run, TOML."""
        write_bytes(self.file("config.toml"), settings.encode())

    def write_status(self, status: str, **facts: Any) -> None:
        """Record the state of the run: ``running``, ``finished`` or ``diverged``, with additional JSON values."""
        check_held(self.file(".lock"), self._lock)
        write_json(self.file(STATUS), {"status": status, "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **facts})

    def finish(self) -> None:
        """Record the end of the run, and delete what only an unfinished run reads."""
        if not self.is_finished:
            self.write_status(FINISHED)
        self.remove_parts()

    def status(self) -> dict[str, object]:
        """Return the recorded state of the run with its additional values; empty before the first one."""
        return _status_of(self.path)

    def remove_parts(self) -> None:
        """Delete the folders of its single trainings, which only an unfinished run reads."""
        # Not through a link: what it points to is not ours.
        shutil.rmtree(self.path / PARTS, ignore_errors=True)

    def write_history(self, rows: list[dict[str, object]]) -> None:
        """Write one line of JSON with a hash for each epoch."""
        check_held(self.file(".lock"), self._lock)
        write_bytes(self.file("history.jsonl"), "".join(map(seal_line, rows)).encode())


def state_of(folder: str | Path) -> str:
    """Return the recorded state of a run: ``running``, ``finished`` or ``diverged``; empty without a record.

    Raises:
        StorageError: the record is damaged.
    """
    return str(_status_of(folder).get("status", ""))


def _status_of(folder: str | Path) -> dict[str, object]:
    file = Path(folder) / STATUS
    return read_object(file, ("status", "time")) if is_there(file) else {}


def describe_unfinished(folder: str | Path) -> str:
    """Return the message about an unfinished run; an empty text if the folder has no unfinished run.

    Every command that opens a run and misses the result says this.

    Raises:
        StorageError: the status of the run is damaged.
    """
    path = Path(folder)
    started = is_file_at(path / IDENTITY) or all(is_file_at(path / name) for name in LEFT)
    if not started or state_of(path) in ENDED:
        return ""
    holder = find_holder(path / ".lock")
    state = "it was stopped" if holder is None else f"process {holder} is at work"
    todo = "give the command that began it again to continue" if holder is None else "wait until it ends"
    return f"'{path}' holds a run that is not finished ({state}); {todo}"


def missing_text(folder: str | Path, kind: str, what: str = "", file: str = "") -> str:
    """Return the message about a folder without the result of a kind of run: unfinished, of another kind, or no run.

    Args:
        folder: folder given to a command.
        kind: name of the kind of run that the command reads, see `edp.storage.run_kinds`.
        what: noun phrase for what is read; by default the run of its command.
        file: missing file; by default the result of the kind.

    Raises:
        StorageError: the folder cannot be looked into, or its identity or status is damaged.
    """
    asked, present = RUN_KINDS[kind], run_kind(folder)
    reason = f"it has no {file or Path(asked.result).name}"
    if present is not None and present != asked:
        reason += f" and holds a run of {present.command}"
    what = what or f"a run of {asked.command}"
    other = f"'{folder}' is not {what}: {reason}; give a folder that {asked.command} wrote"
    return describe_unfinished(folder) or other


def run_kind(folder: str | Path) -> RunKind | None:
    """Return the kind of the run in a folder; None for a folder without a run.

    Raises:
        StorageError: the folder cannot be looked into, or the identity of the run is damaged.
    """
    path = Path(folder)
    identity = read_object(path / IDENTITY) if is_file_at(path / IDENTITY) else {}
    stated = RUN_KINDS.get(str(identity.get("kind")))
    return stated or next((kind for kind in RUN_KINDS.values() if is_file_at(path / kind.result)), None)


def check_claimable(path: str | Path | Run, kind: str) -> None:
    """Refuse a folder that `Run` would refuse; call it before logs are read or anything is computed.

    Nothing is made or changed: a command that is refused later leaves no folder. A run that is open already passes.

    Args:
        path: path of a future run folder, or an open run.
        kind: name of the kind of run, see `edp.storage.run_kinds`.

    Raises:
        BusyError: another process holds it.
        StorageError: it holds a run of another kind, or is a folder of something else, such as a store.
    """
    if isinstance(path, Run):
        return
    asked, present = RUN_KINDS[kind], run_kind(path)
    if present is not None and present != asked:
        raise StorageError(
            f"'{path}' holds a run of {present.command}, into which {asked.command} does not write; nothing was "
            "changed. Choose a new or empty folder"
        )
    if present is None:
        check_kind(path, "run", what=asked.command)
    holder = find_holder(Path(path) / ".lock")
    if holder is not None:
        raise _busy(Path(path), holder)


def check_visible(path: str | Path) -> None:
    """Refuse a run folder that only the node of a cluster sees that wrote it.

    Raises:
        ConfigError: the run is not here.
    """
    if not is_file_at(Path(path, "config.toml")):
        raise ConfigError(
            f"the run was written on another node, and is not in '{full_path(Path(path))}' here; give a folder that "
            "all nodes see under the same path"
        )


def _busy(path: Path, holder: str) -> BusyError:
    return BusyError(f"run folder '{path}' is in use by process {holder}; wait for it or choose another folder")


def check_free(path: str | Path, what: str) -> None:
    """Refuse a folder in which a new run would lie among the files of something else.

    Args:
        path: path of a future run folder: absent, empty, a run, or left by a killed run.
        what: the command, for the message.

    Raises:
        StorageError: it is a file, or holds something and no run.
    """
    folder = Path(path)
    if not is_there(folder) or is_file_at(folder / IDENTITY):
        return
    if not is_folder_at(folder):
        raise StorageError(f"'{folder}' is a file; {what} writes a folder: choose another name")
    names = sorted(entry.name for entry in entries_of(folder))
    others = [name for name in names if name not in LEFT and TEMPORARY.fullmatch(name) is None]
    if others:
        raise StorageError(
            f"folder '{folder}' is not empty and holds no run ('{others[0][:60]}'); nothing was changed. Choose a new "
            f"or empty folder for {what}"
        )


@dataclass(frozen=True)
class KeyedRun:
    """A run folder with the key of the training in it, by which its checkpoints are known.

    Attributes:
        folder: folder in which the training writes.
        key: key of the training, see `run_key`.
    """

    folder: Run
    key: str


@contextmanager
def part_of(run: KeyedRun | None, name: str) -> Iterator[KeyedRun | None]:
    """Lock and yield a subfolder of a run for one training.

    The run itself is returned for an empty `name`, None without a run.
    """
    if run is None or not name:
        yield run
        return
    with Run(run.folder.path / PARTS / name) as folder:
        yield KeyedRun(folder, run.key)
