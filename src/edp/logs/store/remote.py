"""Stores in a bucket: copied to this machine once, checked by their hashes, and opened there."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

from edp.errors import DataError
from edp.logs.buckets import BucketReader, RemoteFile, cache_folder, check_room
from edp.logs.store.index import INDEX, INDEX_BYTES, LOCK, ROWS, StoreIndex, parse_index, rows_path
from edp.logs.store.opening import check_store
from edp.storage import hold, make_folder, write_bytes
from edp.storage.paths import is_file_at, status_of


def local_store(address: str) -> Path:
    """Return the local folder with a copy of a store in a bucket; a missing or incomplete copy is completed.

    The index holds the hash of every recording, and the copy's name is a hash of address and index: a store that was
    added to is another copy, and what a copy holds is what the index says, by every sample.

    Raises:
        DataError: no store, one that this version does not read, or files that are not what its index says.
        StorageError: the bucket refuses or does not answer, or the disk is too small.
    """
    bucket = BucketReader(address)
    text = bucket.read(f"{address}/{INDEX}", INDEX_BYTES)
    index = parse_index(text.decode(errors="replace"), f"index of the store '{address}'")
    name = hashlib.blake2b(address.encode() + b"\0" + text, digest_size=16).hexdigest()
    folder = make_folder(cache_folder() / name)
    if is_file_at(folder / INDEX):
        return folder
    with hold(folder / LOCK):
        if not is_file_at(folder / INDEX):
            _fill(bucket, address, index, folder, text)
    return folder


def _fill(bucket: BucketReader, address: str, index: StoreIndex, folder: Path, text: bytes) -> None:
    """Copy the missing files; the index comes last, so that an incomplete copy is not taken for a store."""
    make_folder(folder / ROWS)
    missing = [file for file in index.files if _size(rows_path(folder, file.key)) != file.bytes]
    check_room(folder, sum(file.bytes for file in missing), address)
    for file in missing:
        target = rows_path(folder, file.key)
        bucket.copy(RemoteFile(f"{address}/{ROWS}/{target.name}", file.bytes, 0), target)
    write_bytes(folder / INDEX, text)
    try:
        check_store(folder)
    except DataError:
        # The next use copies the files again instead of opening what is not sound.
        for file in index.files:
            rows_path(folder, file.key).unlink(missing_ok=True)
        (folder / INDEX).unlink(missing_ok=True)
        raise


def _size(path: Path) -> int:
    return status_of(path).st_size if is_file_at(path) else -1


@lru_cache(maxsize=64)
def is_remote_store(address: str) -> bool:
    """Return whether a store index exists at an address. The result is cached per process.

    Raises:
        StorageError: the bucket refuses or does not answer.
    """
    try:
        return bool(BucketReader(address).objects(f"{address}/{INDEX}"))
    except DataError:
        return False
