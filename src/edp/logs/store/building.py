"""Building of stores: logs are read once, in batches by several processes; a stopped build can continue."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import WorkUnit
from edp.logs.assemble import Assembly, parts, prepare
from edp.logs.buckets import RemoteFile, copied
from edp.logs.detect import open_log
from edp.logs.formats.names import name_of_file
from edp.logs.repair import Repair, repairs_of
from edp.logs.resolve import resolve
from edp.logs.store.index import (
    BATCH_BYTES,
    INDEX,
    LOCK,
    ROWS,
    RefusedLog,
    RowsFile,
    StoreEntry,
    StoreIndex,
    check_places,
    check_seal,
    index_of,
    is_store,
    listed,
    plain_index,
    read_index,
    rows_path,
    stamped,
    write_plain,
)
from edp.progress import SILENT, Progress
from edp.recording import MACHINE, Digest
from edp.settings.tree import plain_tree
from edp.signals import Channel, SignalMap
from edp.storage import (
    check_writable,
    hold,
    make_folder,
    object_with,
    parse_json,
    read_text,
    release,
    remove_unfinished,
    replacing,
)
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import (
    entries_of,
    files_below,
    full_path,
    is_file_at,
    is_folder_at,
    is_link_at,
    is_there,
    status_of,
)

KEY_SCHEMA = 1
"""Version of the content of `StoredLog.key`."""
PART_SAMPLES = 1 << 16
"""Number of samples of a log that are in memory at a time."""
BATCH_LOG_BYTES = 128 * 2**20
"""Approximate size of the logs in a batch, bytes. A killed process loses at most one batch."""
BATCHES = 64
"""Approximate minimum number of batches of a small data set, so that workers finish at similar times."""
MAX_FILES = 400
"""Approximate maximum number of row files per build. Each is open while the store is open."""


@dataclass(frozen=True)
class StoredLog:
    """A log to be stored, and how it is read; see `edp.logs.source.Log`.

    With `remote` it lies in a bucket, from which it is copied while it is read; `path` is then its address.
    """

    path: Path
    signal_map: SignalMap = field(default_factory=SignalMap)
    repair: Repair = field(default_factory=Repair)
    name: str | None = None
    rows: tuple[int, int] | None = None
    machine: str = ""
    remote: RemoteFile | None = None

    @property
    def where(self) -> str:
        """Its address, or the path of the file in full."""
        return str(full_path(self.path)) if self.remote is None else self.remote.address

    @property
    def size(self) -> int:
        """Bytes of the file, or of the files of a folder."""
        if self.remote is not None:
            return self.remote.size
        return sum(status_of(part).st_size for part in self._files())

    @property
    def key(self) -> str:
        """Hash of location, size, time and reading options of the log."""
        facts = [(str(part), status_of(part).st_size, status_of(part).st_mtime_ns) for part in self._files()]
        if self.remote is not None:
            facts = [(self.remote.address, self.remote.size, self.remote.written_ns)]
        how = [plain_tree(self.signal_map), asdict(self.repair), self.name, self.rows, self.machine]
        text = json.dumps([KEY_SCHEMA, self.where, facts, how], default=str)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _files(self) -> list[Path]:
        if is_folder_at(self.path):
            return sorted(files_below(self.path))
        # One that is gone is refused when it is read.
        return [self.path] if is_there(self.path) else []


@dataclass(frozen=True)
class LogBatch:
    """Logs that one process reads into one file of rows."""

    folder: Path
    key: str
    logs: tuple[tuple[str, StoredLog], ...]

    @property
    def label(self) -> str:
        """For messages."""
        return f"logs from '{self.logs[0][1].path}' on"


def build_store(
    logs: Sequence[StoredLog],
    folder: str | Path,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
) -> StoreIndex:
    """Read logs into a store. Unchanged logs are reused; changed logs are read again.

    Args:
        logs: logs in any order.
        folder: folder of the store: a new one, an unfinished one, or an existing one to which logs are added.
        workers: who reads the logs; nodes see logs and store under the same paths.
        progress: receiver of the progress; its units are logs.

    Returns:
        the index of the store. Logs that cannot be read are listed in it as refused, and are tried again next time.

    Raises:
        ConfigError: the folder holds other things than a store.
        StorageError: it cannot be written.
        BusyError: another process builds it.
    """
    top = Path(folder)
    if is_there(top) and not is_store(top) and any(entries_of(top)):
        raise ConfigError(f"'{top}' is no store and not empty; give --out a new folder, or one that a store lies in")
    make_folder(top)
    lock = hold(top / LOCK)
    try:
        check_writable(make_folder(top / ROWS))
        remove_unfinished(top / ROWS)
        remove_unfinished(top)
        return _build_index({log.key: log for log in logs}, top, workers, progress)
    finally:
        release(top / LOCK, lock) if is_file_at(top / INDEX) else lock.close()


def _build_index(logs: dict[str, StoredLog], top: Path, workers: Workers, progress: Progress) -> StoreIndex:
    before = read_index(top) if is_file_at(top / INDEX) else StoreIndex()
    index = _drop_replaced(_drop_lost(before, top), logs)
    for batch_index in _records_beside(top, index):
        index = _add_record(index, batch_index, logs)
    stored = {entry.log_key for entry in index.recordings}
    index = replace(index, refused=())
    missing = {key: log for key, log in logs.items() if key not in stored}
    batches = _batches(missing, full_path(top))
    done = len(logs) - len(missing)
    read = progress.stage("log", len(logs))
    read.step(done)
    refused = 0
    indices: dict[int, StoreIndex] = {}
    for number, result in workers.map([_unit(batch) for batch in batches]):
        batch = batches[number]
        where = f"record of {batch.label}"
        indices[number] = index_of(parse_json((result.content or b"").decode(), where, DataError), where)
        if indices[number].recordings and not is_file_at(rows_path(top, batch.key)):
            raise StorageError(
                f"{batch.label} was stored on another node, and is not in '{full_path(top)}' here; give a folder that "
                "all nodes see under the same path"
            )
        done += len(batch.logs)
        refused += len(indices[number].refused)
        read.step(done, refused=refused)
    for number in range(len(batches)):
        index = _add_record(index, indices[number], logs)
    order = {key: number for number, key in enumerate(logs)}
    # As the logs are in order; those of earlier builds first.
    recordings = sorted(index.recordings, key=lambda entry: order.get(entry.log_key, -1))
    index = _sort_index(replace(index, recordings=tuple(recordings)))
    write_plain(top / INDEX, plain_index(index))
    _remove_unused(top, index)
    return index


def _sort_index(index: StoreIndex) -> StoreIndex:
    """Return the index with files and lists of channels in the order of the recordings, whoever read first."""
    files = {file.key: file for file in index.files}
    used = dict.fromkeys(entry.rows for entry in index.recordings)
    lists: list[tuple[Channel, ...]] = []
    recordings = []
    for entry in index.recordings:
        lists, number = listed(lists, index.lists[entry.channels])
        recordings.append(replace(entry, channels=number))
    rows = tuple(files[key] for key in used)
    return replace(index, lists=tuple(lists), files=rows, recordings=tuple(recordings))


def _drop_replaced(index: StoreIndex, logs: dict[str, StoredLog]) -> StoreIndex:
    """Return the index without recordings whose log was changed or is read with other options."""
    paths = {log.where for log in logs.values()}
    unchanged = tuple(entry for entry in index.recordings if entry.log not in paths or entry.log_key in logs)
    used = {entry.rows for entry in unchanged}
    return replace(index, recordings=unchanged, files=tuple(file for file in index.files if file.key in used))


def _drop_lost(index: StoreIndex, top: Path) -> StoreIndex:
    """Return the index without recordings whose data file is missing or truncated; their logs are read again."""
    whole = {file.key for file in index.files if _size(rows_path(top, file.key)) == file.bytes}
    recordings = tuple(entry for entry in index.recordings if entry.rows in whole)
    return replace(index, recordings=recordings, files=tuple(file for file in index.files if file.key in whole))


def _size(path: Path) -> int:
    """Return the bytes of a regular file; -1 for anything else."""
    return status_of(path).st_size if is_file_at(path) and not is_link_at(path) else -1


def _batches(logs: dict[str, StoredLog], folder: Path) -> list[LogBatch]:
    """Divide logs into batches of similar size, which do not depend on the number of workers."""
    sizes = {key: log.size for key, log in logs.items()}
    total = sum(sizes.values())
    bound = max(min(BATCH_LOG_BYTES, total // BATCHES), total // MAX_FILES)
    groups: list[list[tuple[str, StoredLog]]] = []
    left = 0
    for key, log in logs.items():
        if not groups or left < sizes[key]:
            groups.append([])
            left = bound
        groups[-1].append((key, log))
        left -= sizes[key]
    keys = ("".join(key for key, _ in group) for group in groups)
    digests = (hashlib.blake2b(key.encode(), digest_size=16).hexdigest() for key in keys)
    return [LogBatch(folder, digest, tuple(group)) for digest, group in zip(digests, groups, strict=True)]


def _unit(batch: LogBatch) -> WorkUnit:
    arguments = {"logs": [key for key, _ in batch.logs]}
    return WorkUnit(f"{__name__}:read_batch", batch.label, arguments, batch.key, {"batch": batch})


def read_batch(identity: TrainingIdentity, where: Mapping[str, LogBatch]) -> WithState:
    """Read the logs of a batch into the rows of a store, and leave their record next to them.

    Raises:
        ConfigError: a log is not the same file on this node, or the store is not on it.
    """
    batch = where["batch"]
    if not is_folder_at(batch.folder / ROWS):
        raise ConfigError(f"the store '{batch.folder}' is not on this node; give a folder that all nodes see")
    for key, log in batch.logs:
        if log.remote is None and is_there(log.path) and log.key != key:
            raise ConfigError(
                f"'{log.path}' has another size or time on this node; all nodes must see the same file under that path"
            )
    return WithState({}, json.dumps(store_batch(batch)).encode())


def store_batch(batch: LogBatch) -> dict[str, object]:
    """Read the logs of a batch into one data file, in a separate process.

    Returns:
        the record of the batch: an index of its recordings alone, as plain values. It lies beside the rows, too, so
        that a coordinator that is killed does not read them again.
    """
    path = rows_path(batch.folder, batch.key)
    index, first = StoreIndex(), 0
    with replacing(path) as temporary, temporary.open("wb") as stream:
        for key, log in batch.logs:
            at = stream.tell()
            try:
                with nullcontext(log.path) if log.remote is None else copied(log.remote) as near:
                    entry, channels = _store_log(replace(log, path=near), key, batch.key, first, stream.write)
                # What a recording says of its source must not be the copy, which is gone.
                entry = replace(
                    entry,
                    log=log.where,
                    source=entry.source.replace(str(near), log.where) if log.remote else entry.source,
                )
            except EdpError as error:
                # What was written of it is overwritten by the next one.
                stream.seek(at)
                stream.truncate()
                index = replace(
                    index,
                    refused=(
                        *index.refused,
                        RefusedLog(log=log.where if log.remote else str(log.path), why=str(error)),
                    ),
                )
                continue
            lists, number = listed(index.lists, channels)
            entry = replace(entry, channels=number)
            index = replace(index, lists=tuple(lists), recordings=(*index.recordings, entry))
            first += entry.samples * len(channels)
    if index.recordings:
        index = replace(index, files=(stamped(batch.folder, RowsFile(key=batch.key)),))
    else:
        path.unlink()
    record = plain_index(index)
    if index.recordings:
        write_plain(path.with_suffix(".json"), record)
    return record


def _store_log(
    log: StoredLog, key: str, rows: str, first: int, write: Callable[[Any], object]
) -> tuple[StoreEntry, tuple[Channel, ...]]:
    """Write the samples of a log and return its index entry."""
    raw = open_log(log.path, log.signal_map)
    sources, problems = resolve(raw, log.signal_map)
    if problems:
        raise problems[0]
    assembly = prepare(raw, sources, log.signal_map, log.repair, log.rows)
    channels = tuple(entry.channel for entry in sources)
    digest = Digest(assembly.rate_hz, channels)
    meta = dict(raw.meta)
    source = str(log.path)
    name = log.name or raw.name or name_of_file(raw.path)
    for part in parts(assembly, PART_SAMPLES, name):
        digest.update(part.values)
        write(np.ascontiguousarray(part.values, dtype="<f4").data)
        source, meta = part.source, _merge_meta(meta, part.meta)
    _check_digest(assembly, digest.text)
    if log.machine:
        meta[MACHINE] = log.machine
    entry = StoreEntry(
        name=name,
        log=str(full_path(log.path)),
        log_key=key,
        source=source,
        rate_hz=assembly.rate_hz,
        channels=0,
        rows=rows,
        first=first,
        samples=assembly.samples,
        digest=digest.text,
        meta=json.dumps(meta, allow_nan=False),
    )
    return entry, channels


def _merge_meta(meta: Mapping[str, object], part: Mapping[str, object]) -> dict[str, object]:
    """Merge the metadata of a log with the metadata of another part; list each repair once."""
    repairs = repairs_of(meta)
    repairs += [repair for repair in repairs_of(part) if repair not in repairs]
    return {**meta, **part, **({"repairs": repairs} if repairs else {})}


def _check_digest(assembly: Assembly, digest: str) -> None:
    if assembly.untouched and assembly.raw.digest is not None and digest != assembly.raw.digest:
        raise DataError(
            f"'{assembly.raw.path}': the values are not the ones that EDP wrote; the file is damaged, or was changed "
            "by another program: copy it again, or where the change is wanted, remove EDP's facts from it (edp_info)"
        )


def _records_beside(top: Path, index: StoreIndex) -> Iterator[StoreIndex]:
    """Yield the batch records of an earlier build that are not in the index. Logs of damaged records are read again."""
    present = {file.key for file in index.files}
    for path in entries_of(top / ROWS, "*.json"):
        if path.stem in present or not is_file_at(rows_path(top, path.stem)):
            continue
        where = f"record of the store '{path}'"
        with suppress(DataError):
            table = parse_json(read_text(path, BATCH_BYTES, where, DataError), where, DataError)
            record = object_with(table, ("files", "recordings"), where, DataError)
            record = check_seal(record, where)
            batch = index_of(record, where)
            check_places(batch, where)
            if [(file.key, file.bytes) for file in batch.files] == [(path.stem, _size(rows_path(top, path.stem)))]:
                yield batch


def _add_record(index: StoreIndex, batch: StoreIndex, logs: dict[str, StoredLog]) -> StoreIndex:
    """Return the index extended by the requested recordings of a batch."""
    lists = list(index.lists)
    recordings = list(index.recordings)
    there = {entry.log_key for entry in recordings}
    added = [entry for entry in batch.recordings if entry.log_key in logs and entry.log_key not in there]
    for entry in added:
        lists, number = listed(lists, batch.lists[entry.channels])
        recordings.append(replace(entry, channels=number))
    files = (*index.files, *batch.files) if added else index.files
    refused = (*index.refused, *batch.refused)
    return replace(index, lists=tuple(lists), recordings=tuple(recordings), files=files, refused=refused)


def _remove_unused(top: Path, index: StoreIndex) -> None:
    """Remove data files without recordings, and batch records, which the index now contains."""
    used = {file.key for file in index.files}
    for path in entries_of(top / ROWS):
        if path.suffix == ".json" or (path.suffix == ".f32" and path.stem not in used):
            path.unlink(missing_ok=True)
