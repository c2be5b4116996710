"""Ledger on disk: one file per training, written by one coordinator at a time."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any

from edp.errors import BusyError, ConfigError, StorageError
from edp.storage.ledger.claims import free_dead_claims, whole
from edp.storage.ledger.record import FINAL, RECORD_BYTES, SCHEMA, Record, TrainingStatus, body_of, canonical, digest_of
from edp.storage.ledger.states import SUFFIX, read_state, state_path
from edp.storage.locks import check_held, find_holder, hold
from edp.storage.paths import entries_of, is_entry_at, is_file_at, is_there
from edp.storage.reading import object_with, read_bytes, read_object
from edp.storage.writing import make_folder, remove_unfinished, storage_error, write_bytes, write_json


@dataclass(frozen=True)
class Damage:
    """File that is not a complete record."""

    file: Path
    why: str


def read_records(folder: str | Path) -> tuple[dict[str, Record], list[Damage]]:
    """Return all records of a ledger and the damaged files, regardless of its holder. Nothing is changed."""
    whole, damaged = _read(Path(folder, "records"))
    return {key: _parse_record(Path(folder, "records", f"{key}.json"), whole[key]) for key in whole}, damaged


def _parse_record(file: Path, data: bytes) -> Record:
    try:
        return Record.from_bytes(data)
    except (ValueError, StorageError) as error:
        raise StorageError(
            f"'{file}' has the right checksum and is no record of this version: {error}; remove it to have that "
            "training done again"
        ) from error


def _read(folder: Path) -> tuple[dict[str, bytes], list[Damage]]:
    """Return the bytes of the whole records by key, not yet taken apart: with ten thousand that is most of the time."""
    record_bytes: dict[str, bytes] = {}
    damaged = []
    for name in (entry.name for entry in entries_of(folder, "*.json")):
        key, file = name[: -len(".json")], f"{folder}/{name}"
        try:
            data = read_bytes(file, RECORD_BYTES)
            body = body_of(data)
            # Canonical JSON is sorted, so schema and status stand at its end; parsing each record would take longest.
            if f'"schema":{SCHEMA},"status":"'.encode() not in body[-48:]:
                Record.from_bytes(data)  # says which schema it is
            if f'"key":"{key}"'.encode() not in body:
                raise ValueError("it holds the record of another training")
            record_bytes[key] = data
        except (ValueError, KeyError, TypeError) as error:
            damaged.append(Damage(Path(file), str(error)))
        except StorageError as error:
            if not is_entry_at(file):  # set apart by its holder since it was listed
                continue
            if is_file_at(file):
                raise
            damaged.append(Damage(Path(file), str(error)))
    return record_bytes, damaged


@dataclass(frozen=True)
class Opening:
    """Opening of a sealed test set: evaluated networks, reason and time."""

    test_set: str
    judged: tuple[str, ...]
    why: str
    time: str


def _opening(file: Path) -> Opening:
    content = read_object(file)
    if "box" in content:
        raise StorageError(
            f"'{file}' is of an older version of EDP, whose ledgers this one does not read: search again in another "
            "folder, or go on with the version that wrote it"
        )
    object_with(content, (part.name for part in fields(Opening)), f"'{file}'")
    judged = content["judged"]
    if not isinstance(judged, list) or not all(isinstance(key, str) for key in judged):
        raise StorageError(f"'{file}' is damaged: judged must be a list of keys; restore it")
    return Opening(str(content["test_set"]), tuple(judged), str(content["why"]), str(content["time"]))


def check_uncoordinated(folder: str | Path) -> None:
    """Refuse a ledger that another process coordinates; call it before logs are read. Nothing is made or changed.

    Raises:
        BusyError: another process holds it.
    """
    holder = find_holder(Path(folder) / ".lock")
    if holder is not None:
        raise _busy(Path(folder), holder)


def _busy(path: Path, holder: str) -> BusyError:
    return BusyError(f"'{path}' is coordinated by process {holder}; wait for it, stop it, or choose another folder")


class Ledger:
    """A ledger that this process, the coordinator, writes; a second one is refused.

    Folders in it: ``records``, one file a training; ``arrived``, what workers left that is not entered yet; ``claims``,
    trainings under way; ``states``, what trainings go on from that are not over yet; ``quarantine``, damaged files;
    ``set_aside``, records of trainings to be tried again.

    Args:
        folder: made when absent.

    Attributes:
        damaged: records set aside at opening; these trainings count as not done.

    Raises:
        BusyError: another process coordinates here; exit code 75.
        StorageError: the folder cannot be used.
    """

    def __init__(self, folder: str | Path) -> None:
        self.path = make_folder(folder)
        try:
            self._lock = hold(self.path / ".lock")
        except BusyError as error:
            raise _busy(self.path, str(error).rpartition("process ")[2]) from None
        try:
            for part in ("records", "arrived", "states"):
                remove_unfinished(make_folder(self.path / part))
            free_dead_claims(self.path)
            self._enter_arrivals()
            self._unread, self.damaged = _read(self.path / "records")
            self._records: dict[str, Record] = {}
            for damage in self.damaged:
                self._move(damage.file, "quarantine")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Ledger:
        """Return the ledger; leaving the block allows another process to coordinate."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go."""
        self.close()

    def close(self) -> None:
        """Let another process coordinate."""
        self._lock.close()

    def __len__(self) -> int:
        return len({*self._records, *self._unread})

    def __iter__(self) -> Iterator[Record]:
        """Iterate over the records in the order of their keys."""
        for key in list(self._unread):
            self.get(key)
        return iter([self._records[key] for key in sorted(self._records)])

    def get(self, key: str) -> Record | None:
        """Return the record of a training, including lost ones."""
        if key in self._unread:
            self._records[key] = _parse_record(self.path / "records" / f"{key}.json", self._unread.pop(key))
        return self._records.get(key)

    def finished(self, key: str) -> Record | None:
        """Return the record of a training that must not be tried again; None without one."""
        record = self.get(key)
        return record if record is not None and record.status in FINAL else None

    def put(self, record: Record) -> None:
        """Enter a training, and the state that it left; on disk when this returns.

        Raises:
            StorageError: the disk is full (earlier records stay, nothing half written is left), or the ledger holds
                another end of the same training.
        """
        # A lock file that somebody removed lets a second coordinator in, which must not be overwritten.
        check_held(self.path / ".lock", self._lock)
        existing = self.finished(record.key)
        if existing is not None and existing.reported() != record.reported():
            raise StorageError(
                f"training {record.key} is in '{self.path}' as {existing.status} and came again, {record.status}, with "
                "another result; equal trainings must give equal results: is something not in its key?"
            )
        # Before the record: a kill between the two leaves a state without a record, never a record without its state.
        self._take_state(record.key)
        if existing is None:
            write_bytes(self.path / "records" / f"{record.key}.json", record.to_bytes())
            self._records[record.key] = record
        # Last: until the record is on disk, what the worker left is the only copy.
        (self.path / "arrived" / f"{record.key}.json").unlink(missing_ok=True)

    def state(self, key: str) -> Path | None:
        """Return the state file of a training if it is complete; a damaged file is set aside."""
        file = self.path / "states" / f"{key}{SUFFIX}"
        if not is_there(file):
            return None
        if read_state(file) is None:
            self._move(file, "quarantine")
            return None
        return file

    def keep_states(self, keys: Collection[str]) -> None:
        """Remove the states of all trainings except `keys`; records are unchanged."""
        for file in entries_of(self.path / "states", f"*{SUFFIX}"):
            if file.stem not in keys:
                file.unlink(missing_ok=True)

    def digest(self) -> str:
        """Return a hash of all results without measured values such as seconds."""
        return digest_of([record.reported() for record in self])

    def set_aside(self, statuses: Collection[TrainingStatus]) -> int:
        """Put records away so that their trainings are tried again, for example after a cap was raised; how many."""
        chosen = [record.key for record in self if record.status in statuses]
        for key in chosen:
            self._move(self.path / "records" / f"{key}.json", "set_aside")
            del self._records[key]
        return len(chosen)

    def bind(self, facts: Mapping[str, Any]) -> bool:
        """Bind the ledger to its subject, such as data and search space; return True if it was bound to it before.

        Raises:
            ConfigError: it is bound to something else; the message says in which part. Nothing is changed.
        """
        file = self.path / "about.json"
        # For its refusals only: what JSON would change could never be compared again.
        canonical(facts)
        expected = json.loads(json.dumps(facts))
        if not is_there(file):
            write_json(file, expected)
            return False
        stored = read_object(file)
        other = sorted(part for part in {*stored, *expected} if stored.get(part) != expected.get(part))
        if other:
            raise ConfigError(
                f"'{self.path}' was begun with other {' and '.join(other)}; nothing was changed. Go on with the same "
                "ones, or choose another folder"
            )
        return True

    def open_test_set(self, name: str, judged: Sequence[str], why: str, again: bool = False) -> Opening:
        """Record the use of held-out recordings; a repeated opening after a stop counts once.

        Args:
            name: name of the sealed test set.
            judged: keys of what is evaluated on it.
            why: a sentence for the report.
            again: allow a further opening for other models; it is recorded and weakens what the set can show.

        Raises:
            ConfigError: the test set was opened before for something else.
        """
        before = self.openings(name)
        for opening in before:
            if opening.judged == tuple(judged):
                return opening
        if before and not again:
            raise ConfigError(
                f"sealed test set '{name}' was opened on {before[0].time} ({before[0].why}) for other models; "
                "scores on it would no longer be of unseen recordings. Judge on other recordings, or say that it is "
                "opened again"
            )
        opening = Opening(name, tuple(judged), why, time.strftime("%Y-%m-%dT%H:%M:%S%z"))
        write_json(self.path / "openings" / f"{len(self.openings()) + 1:04d}.json", asdict(opening))
        return opening

    def openings(self, name: str | None = None) -> list[Opening]:
        """Return the openings of one or all sealed test sets, oldest first."""
        openings = [_opening(file) for file in entries_of(self.path / "openings", "*.json")]
        return [one for one in openings if name in (None, one.test_set)]

    def _enter_arrivals(self) -> None:
        """Enter what workers had finished when the last coordinator was killed."""
        for file in entries_of(self.path / "arrived", "*.json"):
            target = self.path / "records" / file.name
            if whole(file) is None:
                self._move(file, "quarantine")
            elif whole(target) is None:  # absent, damaged or of a lost training
                if is_entry_at(target) and not is_file_at(target):
                    self._move(target, "quarantine")
                file.replace(target)
            else:
                file.unlink()
        for file in entries_of(self.path / "arrived", f"*{SUFFIX}"):
            if whole(self.path / "records" / f"{file.stem}.json") is None:  # it will be trained again
                file.unlink()
            else:
                self._take_state(file.stem)

    def _take_state(self, key: str) -> None:
        file = state_path(self.path, key)
        try:
            if is_there(file):
                file.replace(self.path / "states" / file.name)
        except OSError as error:
            raise storage_error(file, error, "move") from error

    def _move(self, file: Path, folder: str) -> None:
        target = make_folder(self.path / folder)
        # Numbered: the same training may be damaged or set aside more than once.
        number = len(entries_of(target, f"{file.stem}.*"))
        try:
            file.replace(target / f"{file.stem}.{number}{file.suffix}")
        except OSError as error:
            raise storage_error(file, error, "move") from error
