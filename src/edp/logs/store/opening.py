"""Recordings of a store: their samples stay in its files and come into memory where they are read."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, StorageError
from edp.logs.read import alike, unique_names
from edp.logs.store.index import (
    INDEX,
    NUMBER_BYTES,
    RowsFile,
    StoreEntry,
    StoreIndex,
    plain_index,
    read_index,
    rows_path,
    stamped,
    write_plain,
)
from edp.recording import FloatArray, Recording
from edp.storage import object_with, parse_json
from edp.storage.paths import is_file_at, is_link_at
from edp.storage.seals import digest_of_bytes

_compared: set[str] = set()
"""Files that this process has compared with their hashes: each is read once for it, not at every opening."""


def read_store(folder: str | Path) -> list[Recording]:
    """Return the recordings of a store like `edp.logs.read_data_set`, without loading samples.

    Raises:
        DataError: no finished store, a file of it that is cut or was changed, or recordings that do not belong
            together: mixed rates or channels.
    """
    top = Path(folder)
    index = read_index(top)
    if not index.recordings:
        raise DataError(f"the store '{folder}' holds no recording; {_describe_refused(index)}")
    files = {file.key: _map_file(top, file) for file in index.files}
    _check_changed(top, index, files)
    recordings = [recording_of(entry, index, files[entry.rows]) for entry in index.recordings]
    logs = [Path(entry.log) for entry in index.recordings]
    names = unique_names([recording.name for recording in recordings], logs)
    named = [replace(recording, name=name).with_digest(recording.digest) for recording, name in zip(recordings, names)]
    return alike(named, logs)


def recording_of(entry: StoreEntry, index: StoreIndex, values: FloatArray) -> Recording:
    """Return one recording of a file of samples."""
    channels = index.lists[entry.channels]
    where = f"meta of recording {entry.name[:80]!r}"
    meta = object_with(parse_json(entry.meta, where, DataError), (), where, DataError)
    stop = entry.first + entry.samples * len(channels)
    rows = values[entry.first : stop].reshape(entry.samples, len(channels))
    return Recording(entry.name, channels, rows, entry.rate_hz, entry.source, meta).with_digest(entry.digest)


def check_store(folder: str | Path) -> StoreIndex:
    """Read every sample and compare it with its hash. A checked copy is not hashed again at each use.

    Raises:
        DataError: no finished store, or a recording that is not what was stored; all of them are named.
    """
    top = Path(folder)
    index = read_index(top)
    files = {file.key: _map_file(top, file) for file in index.files}
    _refuse_changed(top, index, files, {file.key for file in index.files})
    fresh = tuple(stamped(top, file) for file in index.files)
    if fresh != index.files:
        index = replace(index, files=fresh)
        write_plain(top / INDEX, plain_index(index))
    return index


def _map_file(folder: Path, file: RowsFile) -> FloatArray:
    """Map a data file into memory, shape ``(values,)``. Changes remain in this process."""
    size = _status(folder, file).st_size
    path = rows_path(folder, file.key)
    if size != file.bytes or size % NUMBER_BYTES or size == 0:
        raise DataError(
            f"'{path}' has {size:,} bytes, {file.bytes:,} were stored; it is cut or damaged: copy the store again, or "
            "remove this file and build again"
        )
    try:
        # Copy on write: torch takes arrays that could be written without a word, and the file stays as it is.
        mapped = np.memmap(path, dtype="<f4", mode="c")
    except (OSError, ValueError) as error:
        raise StorageError(f"'{path}' cannot be mapped into memory: {error}") from error
    values: NDArray[np.float32] = mapped.view(np.ndarray)
    return values.astype(np.float32, copy=False)


def _status(folder: Path, file: RowsFile) -> os.stat_result:
    path = rows_path(folder, file.key)
    try:
        status = path.lstat()
    except OSError as error:
        raise DataError(
            f"'{path}', a file of the store, cannot be read: {error.strerror or error}; copy the store again, or give "
            "the same `edp data store build` again, which reads its logs anew"
        ) from error
    if is_link_at(path) or not is_file_at(path):
        raise DataError(f"'{path}' must be a regular file of the store; it is a link, a folder or a device")
    return status


def _check_changed(folder: Path, index: StoreIndex, files: dict[str, FloatArray]) -> None:
    """Compare the recordings of a file with their hashes where the file was written, copied or moved since."""
    touched = {file.key: file for file in index.files if not file.is_unchanged(_status(folder, file))}
    tokens = {key: _token(folder, file, index) for key, file in touched.items()} if touched else {}
    later = {key for key, token in tokens.items() if token not in _compared}
    if later:
        _refuse_changed(folder, index, files, later)
        _compared.update(tokens[key] for key in later)


def _token(folder: Path, file: RowsFile, index: StoreIndex) -> str:
    """Return the key of a verification: state of the file and hashes of its recordings."""
    status = _status(folder, file)
    state = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    stated = [(entry, index.lists[entry.channels]) for entry in index.recordings if entry.rows == file.key]
    return digest_of_bytes(repr((str(rows_path(folder, file.key)), state, stated)).encode())


def _refuse_changed(folder: Path, index: StoreIndex, files: dict[str, FloatArray], keys: set[str]) -> None:
    changed = []
    for entry in index.recordings:
        if entry.rows in keys:
            # Without the hash that the index states, so that it is taken of the samples.
            recording = replace(recording_of(entry, index, files[entry.rows]))
            if recording.digest != entry.digest:
                changed.append(entry)
    if changed:
        names = ", ".join(entry.name for entry in changed[:8])
        more = f" and {len(changed) - 8} more" if len(changed) > 8 else ""
        keys = {entry.rows for entry in changed}
        raise DataError(
            f"the store '{folder}' was changed since it was built: {names}{more} of "
            f"{', '.join(str(rows_path(folder, key)) for key in sorted(keys)[:4])} have other samples than their hash "
            "says; remove these files and build again"
        )


def _describe_refused(index: StoreIndex) -> str:
    kinds = Counter(refused.why for refused in index.refused)
    most = kinds.most_common(1)
    return f"{len(index.refused)} log(s) were refused: {most[0][0]}" if most else "build it from logs"
