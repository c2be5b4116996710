"""Index of a store: its recordings, the positions of their samples, and refused logs."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.errors import ConfigError, DataError
from edp.logs.formats.base import check_names
from edp.settings.bounds import above
from edp.settings.tree import SettingsTree
from edp.signals import Channel
from edp.storage import object_with, parse_json, read_text, write_bytes
from edp.storage.paths import is_file_at, is_folder_at, status_of
from edp.storage.seals import HASH, sealed, unsealed

INDEX, ROWS, LOCK = "store.json", "rows", ".lock"
KIND, SCHEMA = "edp-store", 2
UNSEALED_SCHEMA = 1
"""Of indexes without a hash: every recording is compared with its own hash when such a store is opened."""
INDEX_BYTES = 512 * 2**20
"""Of an index; an entry of a recording takes some 500 bytes, so that a million fit."""
BATCH_BYTES = 64 * 2**20
"""Of the record of one batch of logs."""
NUMBER_BYTES = 4
BUILD_AGAIN = "remove the store and build it again from its logs"
KEY = re.compile(r"[0-9a-f]{32}")
RATE = above(0.0, 1e6)
MAX_NS = 2**63
"""Of a time in nanoseconds since 1970: the year 2262."""
"""What names a file of rows: a key leads to no other folder."""
_TREE = SettingsTree(what="index of the store")


@dataclass(frozen=True, kw_only=True)
class StoreEntry:
    """One recording of a store.

    Attributes:
        name: as the log states it; names are made unique when the store is read.
        log: path of the log that it was read from.
        log_key: hash of path, size and time of that log, and of how it was read.
        source: `Recording.source`.
        rate_hz: samples per second.
        channels: number of its list of channels in the index.
        rows: key of the file that holds its samples.
        first: number of the value in that file with which it begins.
        samples: its ticks.
        digest: `Recording.digest`.
        meta: `Recording.meta` as JSON.
    """

    name: str
    log: str
    log_key: str
    source: str
    rate_hz: float
    channels: int
    rows: str
    first: int
    samples: int
    digest: str
    meta: str = "{}"


@dataclass(frozen=True, kw_only=True)
class RowsFile:
    """A file of samples.

    Attributes:
        key: name of the file.
        bytes: its size.
        written_ns: when its content was last written, in nanoseconds since 1970; programs can set it.
        changed_ns: when the system last changed it in any way (ctime), which no program can set; 0 where it is not
            known that the file is as it was stored.
    """

    key: str
    bytes: int = 0
    written_ns: int = 0
    changed_ns: int = 0

    def is_unchanged(self, status: os.stat_result) -> bool:
        """Return whether the file was not touched since its samples were compared with their hashes."""
        return (self.written_ns, self.changed_ns) == (status.st_mtime_ns, status.st_ctime_ns)


@dataclass(frozen=True, kw_only=True)
class RefusedLog:
    """A log that could not be read, and why."""

    log: str
    why: str


@dataclass(frozen=True, kw_only=True)
class StoreIndex:
    """Content of a store.

    Attributes:
        kind: ``edp-store``.
        schema: version of this form.
        lists: the lists of channels that recordings have.
        files: files of samples.
        recordings: in the order of their logs.
        refused: logs that are not in it.
    """

    kind: str = KIND
    schema: int = SCHEMA
    lists: tuple[tuple[Channel, ...], ...] = ()
    files: tuple[RowsFile, ...] = ()
    recordings: tuple[StoreEntry, ...] = ()
    refused: tuple[RefusedLog, ...] = field(default=())

    def hours(self) -> float:
        """Return the duration of all recordings."""
        return sum(entry.samples / entry.rate_hz for entry in self.recordings) / 3600.0


def is_store(path: str | Path) -> bool:
    """Return whether a folder is a store, finished or not."""
    folder = Path(path)
    return is_file_at(folder / INDEX) or (is_folder_at(folder / ROWS) and is_file_at(folder / LOCK))


def rows_path(folder: Path, key: str) -> Path:
    """Return the path of the data file with this key."""
    return folder / ROWS / f"{key}.f32"


def stamped(folder: Path, file: RowsFile) -> RowsFile:
    """Return the entry of a verified file with its current size and time stamps."""
    status = status_of(rows_path(folder, file.key))
    return replace(file, bytes=status.st_size, written_ns=status.st_mtime_ns, changed_ns=status.st_ctime_ns)


def read_index(folder: str | Path) -> StoreIndex:
    """Read and check the index of a store: every recording is within a data file.

    Raises:
        DataError: no store, one that is half built, of another schema, or damaged.
    """
    path = Path(folder) / INDEX
    where = f"index of the store '{folder}'"
    if not is_store(folder):
        raise DataError(
            f"'{folder}' is no store: it has no {INDEX}; `edp data store build LOGS --out {folder}` makes one"
        )
    if not is_file_at(path):
        raise DataError(
            f"the store '{folder}' is half built: it has no {INDEX} yet; give the same `edp data store build` "
            f"again, it "
            "goes on where it stopped"
        )
    return parse_index(read_text(path, INDEX_BYTES, where, DataError), where)


def parse_index(text: str, where: str) -> StoreIndex:
    """Parse and check the content of an index file: every recording is within a data file.

    Raises:
        DataError: it is of another schema, or damaged.
    """
    table = object_with(parse_json(text, where, DataError), ("kind", "schema"), where, DataError)
    if table["kind"] != KIND:
        raise DataError(f"{where}: kind = {str(table['kind'])[:40]!r}, expected '{KIND}'; it is no store of EDP")
    if isinstance(table["schema"], bool) or table["schema"] not in (UNSEALED_SCHEMA, SCHEMA):
        raise DataError(
            f"{where}: schema {str(table['schema'])[:40]}, this version of EDP reads {UNSEALED_SCHEMA} and {SCHEMA}; "
            f"{BUILD_AGAIN}"
        )
    index = index_of(check_seal(table, where), where)
    if index.schema == UNSEALED_SCHEMA:
        # Nothing binds its numbers, so none of its files counts as compared.
        files = tuple(replace(file, changed_ns=0) for file in index.files)
        index = replace(index, schema=SCHEMA, files=files)
    check_places(index, where)
    return index


def check_seal(table: dict[str, object], where: str) -> dict[str, object]:
    """Return an index or the record of a batch without its hash, which is checked.

    Raises:
        DataError: it does not match its hash, or lacks one although its schema has it.
    """
    if table.get("schema") != UNSEALED_SCHEMA and HASH not in table:
        raise DataError(f"{where} is damaged: it lacks its hash ({HASH}); copy the store again, or {BUILD_AGAIN}")
    plain: dict[str, object] = unsealed(table, where, DataError)
    return plain


def index_of(table: object, where: str) -> StoreIndex:
    """Build an index from JSON types, checking each type.

    Raises:
        DataError: what is wrong, and where.
    """
    try:
        index = _TREE.build(StoreIndex, table, where)
    except ConfigError as error:
        raise DataError(f"{error}; {BUILD_AGAIN}") from error
    for channels in index.lists:
        check_names(Path(where), [channel.name for channel in channels])
    return index


def plain_index(index: StoreIndex) -> dict[str, object]:
    """Convert an index to JSON types."""
    plain: dict[str, object] = _TREE.to_dict(index)
    return plain


def write_plain(path: Path, plain: dict[str, object]) -> None:
    """Write an index or the record of a batch under a hash, whole or not at all."""
    write_bytes(path, json.dumps(sealed(plain), allow_nan=False, separators=(",", ":")).encode())


def check_places(index: StoreIndex, where: str) -> None:
    """Refuse recordings that lie outside their files, and files outside the store."""
    sizes = {file.key: file.bytes // NUMBER_BYTES for file in index.files}
    for file in index.files:
        if not KEY.fullmatch(file.key):
            raise DataError(f"{where}: a file of rows is called {file.key[:60]!r}; 32 hexadecimal digits must hold")
        if file.bytes < 0 or not (0 <= file.written_ns < MAX_NS and 0 <= file.changed_ns < MAX_NS):
            raise DataError(f"{where}: file {file.key} has a size or time out of bounds; {BUILD_AGAIN}")
    for entry in index.recordings:
        if not 0 <= entry.channels < len(index.lists) or not index.lists[entry.channels]:
            raise DataError(
                f"{where}: recording {entry.name[:80]!r} has the list of channels {entry.channels}, there are "
                f"{len(index.lists)}, and none may be empty; {BUILD_AGAIN}"
            )
        if not RATE.holds(entry.rate_hz):
            raise DataError(
                f"{where}: recording {entry.name[:80]!r} has {entry.rate_hz} Hz; {RATE.rule('a rate')} is required"
            )
        if not KEY.fullmatch(entry.digest):
            raise DataError(
                f"{where}: recording {entry.name[:80]!r} has the hash {entry.digest[:40]!r}; 32 hexadecimal digits are "
                f"required; {BUILD_AGAIN}"
            )
        stop = entry.first + entry.samples * len(index.lists[entry.channels])
        if entry.rows not in sizes or entry.first < 0 or entry.samples < 1 or stop > sizes[entry.rows]:
            raise DataError(
                f"{where}: recording {entry.name[:80]!r} lies at values {entry.first} to {stop} of file "
                f"{entry.rows[:40]!r}, which the store does not have; {BUILD_AGAIN}"
            )


def listed(
    lists: Sequence[tuple[Channel, ...]], channels: tuple[Channel, ...]
) -> tuple[list[tuple[Channel, ...]], int]:
    """Return the lists of channels with a new list appended if necessary, and its number."""
    merged_lists = list(lists)
    if channels not in merged_lists:
        merged_lists.append(channels)
    return merged_lists, merged_lists.index(channels)
