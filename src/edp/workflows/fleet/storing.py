"""`edp store build` by a pool or a cluster: a unit a batch of logs, whose rows and record whoever reads it leaves.

The build proper then finds these records as those of a build that was stopped, and has nothing left to read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edp.errors import ConfigError, DataError, StorageError
from edp.jobs import Workforce
from edp.jobs.units import UnitResult, WorkUnit, run_units
from edp.logs.repair import Repair
from edp.logs.source import DataSource
from edp.logs.store import StoreIndex
from edp.logs.store.building import BATCH_LOG_BYTES, BATCHES_A_WORKER, MOST_FILES, LogBatch, StoredLog, store_batch
from edp.logs.store.index import INDEX, LOCK, ROWS, is_store, read_index, rows_path
from edp.progress import SILENT, Progress
from edp.settings.tree import build, plain_tree
from edp.signals import SignalMap
from edp.storage import check_writable, hold, make_folder, read_object, release
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import entries_of, full_path, is_file_at, is_folder_at, is_there

SIDE_BY_SIDE = 16
"""Readers that a cluster is taken to have when logs are put into batches: few enough that files stay large."""


def store_with(
    workforce: Workforce,
    source: DataSource,
    folder: str | Path,
    progress: Progress = SILENT,
) -> StoreIndex:
    """As `edp.logs.source.DataSource.store`, by a workforce.

    Args:
        workforce: who reads the logs; nodes see logs and store under the same paths.
        source: logs.
        folder: of the store.
        progress: receiver of the progress; its units are logs.

    Raises:
        EdpError: as `DataSource.store`, or the nodes do not see logs or store.
    """
    logs = {log.key: log for log in stored_logs(source)}
    top = Path(folder)
    if logs and (not is_there(top) or is_store(top) or not any(entries_of(top))):
        make_folder(top)
        lock = hold(top / LOCK)
        try:
            check_writable(make_folder(top / ROWS))
            _read_batches(logs, top, workforce, progress)
        finally:
            release(top / LOCK, lock) if is_file_at(top / INDEX) else lock.close()
    # It enters what the units left, and says what stands against a folder that is no store.
    return source.store(folder, 1, progress)


def stored_logs(source: DataSource) -> list[StoredLog]:
    """The logs of a source as a store takes them; a store has none."""
    logs = source.logs()
    for log in logs:
        if log.remote is not None:
            raise ConfigError(f"'{log.path}' lies in a bucket, whose logs one computer reads; leave --cluster out")
    return [
        StoredLog(log.path, log.signal_map or SignalMap(), log.repair or Repair(), log.name, log.rows, log.machine)
        for log in logs
    ]


def keys_of(source: DataSource) -> str:
    """What tells two states of a source apart without reading it: hashes of a store, sizes and times of logs."""
    keys = [entry.digest for entry in read_index(source.store_folder()).recordings] if source.stored else []
    return " ".join([*keys, *(log.key for log in stored_logs(source))])


def _read_batches(logs: dict[str, StoredLog], top: Path, workforce: Workforce, progress: Progress) -> None:
    there = _stored_keys(top)
    missing = {key: log for key, log in logs.items() if key not in there}
    batches = _batches(missing, top, workforce.count if not workforce.cluster else SIDE_BY_SIDE)
    units = [_unit(batch) for batch in batches]
    read = progress.stage("log", len(logs))
    counted = {"logs": len(logs) - len(missing), "refused": 0}

    def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
        if result.values["stored"] and not is_file_at(rows_path(top, unit.data)):
            raise StorageError(
                f"{unit.label} was stored on another node, and is not in '{full_path(top)}' here; give a folder that "
                "all nodes see under the same path"
            )
        counted["logs"] += len(unit.arguments["logs"])
        counted["refused"] += int(result.values["refused"])
        read.step(counted["logs"], refused=counted["refused"])

    run_units(units, workforce, on_done=note)


def _stored_keys(top: Path) -> set[str]:
    """Keys of logs whose rows are in the store, or lie in it from a build that was stopped."""
    keys = {entry.log_key for entry in read_index(top).recordings} if is_file_at(top / INDEX) else set()
    for record in entries_of(top / ROWS, "*.json"):
        with suppress(DataError, StorageError, KeyError, TypeError):
            if is_file_at(rows_path(top, record.stem)):
                keys |= {str(entry["log_key"]) for entry in read_object(record)["recordings"]}
    return keys


def _batches(logs: dict[str, StoredLog], top: Path, readers: int) -> list[LogBatch]:
    """Logs side by side, in batches of like size, some for each reader."""
    sizes = {key: log.size for key, log in logs.items()}
    total = sum(sizes.values())
    bound = max(min(BATCH_LOG_BYTES, total // (BATCHES_A_WORKER * readers)), total // MOST_FILES)
    groups: list[list[tuple[str, StoredLog]]] = []
    room = 0
    for key, log in logs.items():
        if not groups or room < sizes[key]:
            groups.append([])
            room = bound
        groups[-1].append((key, log))
        room -= sizes[key]
    return [LogBatch(full_path(top), _batch_key(group), tuple(group)) for group in groups]


def _batch_key(group: list[tuple[str, StoredLog]]) -> str:
    return hashlib.blake2b("".join(key for key, _ in group).encode(), digest_size=16).hexdigest()


def _unit(batch: LogBatch) -> WorkUnit:
    logs = [
        {
            "key": key,
            "path": str(full_path(log.path)),
            "map": plain_tree(log.signal_map),
            "repair": asdict(log.repair),
            "name": log.name,
            "rows": None if log.rows is None else list(log.rows),
            "machine": log.machine,
        }
        for key, log in batch.logs
    ]
    return WorkUnit(f"{__name__}:read_batch", batch.label, {"logs": logs}, batch.key, {"folder": str(batch.folder)})


def read_batch(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, Any]:
    """Read the logs of a batch into the store's rows, and leave their record beside them.

    Raises:
        ConfigError: a log is not the same file on this node, or the store is not on it.
    """
    folder = Path(where["folder"])
    if not is_folder_at(folder / ROWS):
        raise ConfigError(f"the store '{folder}' is not on this node; give a folder that all nodes see")
    logs = tuple((entry["key"], _log(entry)) for entry in identity.config["logs"])
    for key, log in logs:
        if is_there(log.path) and log.key != key:
            raise ConfigError(
                f"'{log.path}' has another size or time on this node; all nodes must see the same file under that path"
            )
    if is_file_at(rows_path(folder, identity.data)) and is_file_at(
        rows_path(folder, identity.data).with_suffix(".json")
    ):
        return {"stored": True, "refused": 0}  # by a worker that was killed before it could say so
    record = store_batch(LogBatch(folder, identity.data, logs))
    return {"stored": bool(record["recordings"]), "refused": len(record["refused"])}


def _log(entry: Mapping[str, Any]) -> StoredLog:
    path, rows = Path(entry["path"]), entry["rows"]
    signal_map = build(SignalMap, entry["map"], f"map of '{path}'")
    repair = build(Repair, entry["repair"], f"repair of '{path}'")
    return StoredLog(
        path, signal_map, repair, entry["name"], None if rows is None else (rows[0], rows[1]), entry["machine"]
    )
