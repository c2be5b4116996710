"""Locks: one process at a time writes to a folder; a lock is released when its process ends in any way."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from edp.errors import BusyError, StorageError
from edp.storage.portable import HELD, NO_LINK, QUIETLY
from edp.storage.portable import lock as lock_file
from edp.storage.writing import storage_error

OURS = re.compile(r"\d{1,10} on [^\n]{1,255} since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d|\x00*")
"""Content of a valid lock file: its last holder, or empty or zero bytes before the first holder."""
HOLDER_BYTES = 400
"""Maximum number of bytes that are read from a lock file."""
_OPEN = NO_LINK | QUIETLY
_ADVICE = "nothing was changed: remove it, if nothing of yours needs it, and try again"


def hold(path: str | Path) -> IO[str]:
    """Lock a file for this process; closing it, or the end of the process, however it ends, frees it.

    A link, folder, pipe or device in the place of the file is refused, and so is a file that holds anything else: only
    what is nothing but a lock is written to, and only once it is locked. A holder may remove the file
    before it closes it: who waited for the removed one then locks the new one.

    Raises:
        BusyError: another process holds it; the message says which.
        StorageError: the file cannot be written, or is no lock file.
    """
    lock = Path(path)
    while True:
        stream = _open_lock(lock)
        try:
            lock_file(stream)
        except OSError as error:
            holder = _holder(stream)
            stream.close()
            # These say that another process holds it, depending on the system; others are faults of the disk.
            if error.errno not in HELD:
                raise storage_error(lock, error, "lock") from error
            raise BusyError(f"'{lock}' is held by process {holder}") from None
        # The file may have been removed between opening and locking: then the lock holds nothing.
        if still_ours(lock, stream):
            break
        stream.close()
    _check_ours(lock, stream)
    try:
        stream.truncate(0)
        stream.write(f"{os.getpid()} on {platform.node()} since {time.strftime('%Y-%m-%d %H:%M:%S')}")
        stream.flush()
    except OSError as error:
        stream.close()
        raise storage_error(lock, error, "write") from error
    return stream


@contextlib.contextmanager
def holding(path: str | Path, what: str) -> Iterator[None]:
    """Hold a lock file while a command works, and remove the file afterwards.

    Args:
        path: path of the lock file.
        what: protected object, for the message.

    Raises:
        BusyError: another process holds it; nothing was changed.
        StorageError: the file cannot be written, or is no lock file.
    """
    try:
        stream = hold(path)
    except BusyError as error:
        holder = str(error).rpartition("process ")[2]
        raise BusyError(
            f"{what} is in use by process {holder}; nothing was changed. Wait for it, or choose another folder"
        ) from None
    try:
        yield
    finally:
        release(path, stream)


def still_ours(path: str | Path, stream: IO[str]) -> bool:
    """Return whether the file at `path` is the one that `hold` locked.

    It is not once somebody removed or replaced it.
    """
    try:
        there, here = os.lstat(path), os.fstat(stream.fileno())
    except FileNotFoundError:
        return False
    except OSError as error:
        raise storage_error(Path(path), error, "read") from error
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)


def release(path: str | Path, stream: IO[str]) -> None:
    """Release a lock and remove its file if it is still ours; waiting processes lock a new file."""
    ours = still_ours(path, stream)
    if os.name != "nt" and ours:
        Path(path).unlink(missing_ok=True)  # first, so that nobody can lock what is about to go
    stream.close()
    if os.name == "nt" and ours:  # Windows removes no open file; a new holder has it open, so that it stays
        with contextlib.suppress(OSError):
            Path(path).unlink()


def check_held(path: str | Path, stream: IO[str]) -> None:
    """Raise an error if the lock file was removed or replaced, so that another process may hold a new lock.

    Raises:
        StorageError: the file at `path` is not the one that is locked.
    """
    if not still_ours(path, stream):
        raise StorageError(
            f"'{path}' was removed or replaced while this process held it, so another one may write here, too; this "
            "one stops. See that only one runs, and give the same command again to go on"
        )


def find_holder(path: str | Path) -> str | None:
    """Return the holder of a file locked by `hold`; None if it is free. Nothing is changed."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | _OPEN), encoding="utf-8", errors="replace") as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                return None
            try:
                lock_file(stream, shared=True)
            except OSError:
                return _holder(stream)
    except OSError:
        return None
    return None


def _open_lock(lock: Path) -> IO[str]:
    """Open the lock file, created if necessary, for appending; its content is not changed."""
    try:
        handle = os.open(lock, os.O_RDWR | os.O_APPEND | os.O_CREAT | _OPEN, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise StorageError(f"'{lock}' is a symbolic link, which is not followed for a lock; {_ADVICE}") from error
        if error.errno in (errno.EISDIR, errno.ENXIO):
            raise StorageError(
                f"'{lock}' is not a lock file but a folder, pipe, socket or device; {_ADVICE}"
            ) from error
        raise storage_error(lock, error, "write") from error
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise StorageError(f"'{lock}' is not a lock file but a pipe, socket or device; {_ADVICE}")
    return os.fdopen(handle, "a+", encoding="utf-8", errors="replace")


def _check_ours(lock: Path, stream: IO[str]) -> None:
    """Raise an error unless the file is a lock, since a hard link may give another file this name."""
    content, names = _read(stream), os.fstat(stream.fileno()).st_nlink
    # An empty file with a second name is somebody's file by a hard link.
    if OURS.fullmatch(content) is None or (names > 1 and not content):
        stream.close()
        why = "has another name, too" if not content else "holds something else"
        raise StorageError(f"'{lock}' is not a lock file: it {why}; {_ADVICE}")


def _read(stream: IO[str]) -> str:
    stream.seek(0)
    return stream.read(HOLDER_BYTES)


def _holder(stream: IO[str]) -> str:
    return _read(stream).strip() or "unknown"
