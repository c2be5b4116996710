"""Writing files so that a kill or a full disk leaves either the old file or the new one, never half of one."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from edp.errors import BusyError, StorageError


def storage_error(path: Path, error: OSError, doing: str) -> StorageError:
    """A message that says what could not be done, where and why."""
    reason = error.strerror or str(error)
    return StorageError(f"cannot {doing} '{path}': {reason}; free space or choose a folder you may write to")


def make_folder(path: str | Path) -> Path:
    """Create a folder and its parents.

    Raises:
        StorageError: the folder cannot be created (read-only parent, a file in the way).
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(folder, error, "create folder") from error
    return folder


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is synced and renamed over `path`, else removed.

    Raises:
        StorageError: the disk is full, the folder is read-only, or the rename failed.
    """
    target = Path(path)
    make_folder(target.parent)
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        temporary.chmod(0o644)
        temporary.replace(target)
        temporary = None
    except OSError as error:
        raise storage_error(target, error, "write") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def hold(path: str | Path) -> IO[str]:
    """Lock a file for this process; closing it, or the end of the process, however it ends, frees it.

    A holder may remove the file before it closes it: who waited for the removed one then locks the new one.

    Raises:
        BusyError: another process holds it; the message says which.
        StorageError: the file cannot be written.
    """
    lock = Path(path)
    while True:
        try:
            stream = lock.open("a+")
        except OSError as error:
            raise storage_error(lock, error, "write") from error
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            stream.seek(0)
            holder = stream.read().strip() or "unknown"
            stream.close()
            raise BusyError(f"'{lock}' is held by process {holder}") from None
        try:
            current = lock.stat().st_ino == os.fstat(stream.fileno()).st_ino
        except FileNotFoundError:
            current = False
        if current:
            break
        stream.close()
    try:
        stream.truncate(0)
        stream.write(f"{os.getpid()} on {os.uname().nodename} since {time.strftime('%Y-%m-%d %H:%M:%S')}")
        stream.flush()
    except OSError as error:
        stream.close()
        raise storage_error(lock, error, "write") from error
    return stream


def held_by(path: str | Path) -> str | None:
    """Who holds a file that `hold` locks, None for nobody; nothing is changed."""
    try:
        with Path(path).open() as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except OSError:
                return stream.read().strip() or "unknown"
    except OSError:
        return None
    return None


def remove_unfinished(folder: Path) -> None:
    """Remove what a process that was killed while it wrote has left; only for who holds the folder."""
    for rest in folder.glob(".*.tmp"):
        rest.unlink(missing_ok=True)


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON atomically; NaN and infinity are refused, they are not JSON."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        StorageError: the file is missing, unreadable or not JSON.
    """
    source = Path(path)
    try:
        return json.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise StorageError(f"cannot read '{source}': {error.strerror or error}") from error
    except ValueError as error:
        raise StorageError(f"'{source}' is not valid JSON ({error}); it may be cut off or edited by hand") from error
