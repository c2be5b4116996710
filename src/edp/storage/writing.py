"""Atomic writing of files: a kill or a full disk leaves either the old file or the new one."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from edp.errors import EdpError, StorageError
from edp.storage.paths import entries_of, is_file_at, is_folder_at, is_link_at, status_at
from edp.storage.portable import BINARY, NO_LINK, QUIETLY, hold_handle, lock_handle
from edp.storage.seals import sealed


def storage_error(path: Path, error: OSError, doing: str) -> StorageError:
    """Return an error that names the failed operation, the path and the reason."""
    reason = error.strerror or str(error)
    return StorageError(f"cannot {doing} '{path}': {reason}; free space or choose a folder you may write to")


_OF_THE_SYSTEM = re.compile(
    r"errno = (\d+)|No space left|File too large|Disk quota|Input/output error|Read-only file"
    r"|disk I/O error|disk is full"
)
"""Texts in error messages of C libraries that report an operating-system error during writing."""


def system_failure(error: BaseException) -> OSError | None:
    """Return the error of the system from which an error of a library stems; None where it has another cause.

    Libraries that write files (HDF5, Arrow, MDF, pictures) wrap it, chain it, or repeat its text.
    """
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen:
        if isinstance(link, OSError):
            return link
        if reason := _OF_THE_SYSTEM.search(str(link)):
            return OSError(int(reason[1]), os.strerror(int(reason[1]))) if reason[1] else OSError(str(link)[:200])
        seen.add(id(link))
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)
    return None


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


def check_writable(folder: str | Path) -> Path:
    """Make a folder and check that files can be written there, before a long job begins. No file remains.

    Raises:
        StorageError: it cannot be made or written.
    """
    path = make_folder(folder)
    try:
        handle, name = _temporary(path / "writable")
        try:
            os.write(handle, b"edp")
        finally:
            os.close(handle)
            os.unlink(name)
    except OSError as error:
        raise storage_error(path, error, "write into") from error
    return path


TEMPORARY = re.compile(r"\..{0,80}\.(?:[0-9a-f]{12}|[a-z0-9_]{8})\.tmp", re.DOTALL)
"""Pattern for the names of unfinished files and folders, including the names that earlier versions used."""


_cleaned: set[str] = set()
"""Folders that this process has already searched for files of killed processes."""
LEFT_AFTER_S = 60.0
"""Minimum age of an unfinished file before another process removes it, s. By then its writer has locked it or has
ended.
"""


def _remove_left(folder: Path) -> None:
    """Remove unfinished files and folders whose writers were killed; once for a folder and process.

    A writer holds what it writes; what can be locked has no writer any more. Windows holds nothing here, so that it
    removes nothing.
    """
    name = os.path.abspath(folder)
    if name in _cleaned or os.name == "nt":
        return
    _cleaned.add(name)
    with contextlib.suppress(StorageError):  # a folder that may be written and not be listed
        for rest in entries_of(folder, ".*.tmp"):
            if TEMPORARY.fullmatch(rest.name) is None or is_link_at(rest):
                continue
            with contextlib.suppress(OSError):
                status = status_at(rest, follow=False)
                if status is None or time.time() - status.st_mtime < LEFT_AFTER_S:
                    continue
                mode = os.O_RDONLY if stat.S_ISDIR(status.st_mode) else os.O_RDWR
                handle = os.open(rest, mode | QUIETLY | NO_LINK)
                try:
                    lock_handle(handle)
                    shutil.rmtree(rest) if is_folder_at(rest) else rest.unlink()
                finally:
                    os.close(handle)


def _temporary(target: Path) -> tuple[int, str]:
    """Create a new file next to `target`, with the permissions that the user's umask gives to new files."""
    while True:
        # Beside the target: a rename is atomic only within a file system. Cut: names have 255 bytes at most.
        name = f"{target.parent}/.{target.name[:80]}.{secrets.token_hex(6)}.tmp"
        with contextlib.suppress(FileExistsError):
            # O_EXCL follows no link that somebody put there, and takes no other process's file.
            return os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | QUIETLY | BINARY, 0o666), name


@contextlib.contextmanager
def _naming(target: Path) -> Iterator[None]:
    """Turn failures of the system, also inside libraries, into one StorageError that names the target."""
    try:
        yield
    except IsADirectoryError as error:
        raise StorageError(f"cannot write '{target}': a folder of this name is in the way; remove or rename it") from (
            error
        )
    except EdpError:
        raise
    except Exception as error:
        failure = system_failure(error)
        if failure is None:
            raise
        raise storage_error(target, failure, "write") from error


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success it is synced and renamed to `path`, otherwise removed.

    Raises:
        StorageError: the disk is full, the folder is read-only, a folder is in the way, or the rename failed.
    """
    target = Path(path)
    make_folder(target.parent)
    temporary: Path | None = None
    handle = -1
    try:
        with _naming(target):
            _remove_left(target.parent)
            handle, name = _temporary(target)
            temporary = Path(name)
            # Lost when the writer closes its own handle; what follows takes less than `LEFT_AFTER_S`.
            hold_handle(handle)
            yield temporary
            with temporary.open("rb+") as stream:
                # Before the rename: after a loss of power the new name must not show an empty file.
                os.fsync(stream.fileno())
            if os.name == "nt":
                os.close(handle)  # Windows renames no open file
                handle = -1
            temporary.replace(target)
            temporary = None
    finally:
        if handle >= 0:
            os.close(handle)
        if temporary is not None:
            with contextlib.suppress(OSError):  # the folder may be gone; the error that is under way says more
                temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder next to `path`; on success it is renamed to `path`, otherwise removed with its content.

    Args:
        path: not there yet, or an empty folder.

    Raises:
        StorageError: the disk is full, the parent is read-only, or something is in the way.
    """
    target = Path(path).absolute()
    make_folder(target.parent)
    temporary = target.parent / f".{target.name[:80]}.{secrets.token_hex(6)}.tmp"
    handle = -1
    try:
        with _naming(target):
            _remove_left(target.parent)
            temporary.mkdir()
            if os.name != "nt":
                handle = os.open(temporary, os.O_RDONLY | QUIETLY)
                hold_handle(handle)
            yield temporary
            if os.name == "nt" and is_folder_at(target):
                target.rmdir()  # Windows renames onto nothing that is there
            temporary.rename(target)
    finally:
        if handle >= 0:
            os.close(handle)
        shutil.rmtree(temporary, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Remove temporary files of killed writers. Only the process that holds the folder may call it."""
    for rest in entries_of(folder, ".*.tmp"):
        # A link of this name is not ours.
        if is_file_at(rest) and not is_link_at(rest):
            rest.unlink(missing_ok=True)


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, value: Mapping[str, object]) -> None:
    """Write an object as JSON with the hash of its content (`edp.storage.seals`); NaN and infinity are refused."""
    write_bytes(path, (json.dumps(sealed(value), indent=1, allow_nan=False) + "\n").encode())
