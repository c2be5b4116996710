"""The folder of an export: one process writes it, it holds one export, and a list of its files comes last.

`LIST` names every file with its SHA-256 (``sha256sum -c export.sha256`` checks it). It is removed before the first file
is touched and written after the last one: a folder without it holds no whole export.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from edp.errors import BusyError, StorageError
from edp.storage import hold, make_folder, storage_error, write_bytes
from edp.storage.folders import check_kind
from edp.storage.paths import entries_of, is_file_at, is_folder_at, is_link_at, status_of
from edp.storage.writing import TEMPORARY

LIST = "export.sha256"
UNFINISHED = "export.unfinished"
"""File that lists, while an export is written, the files of the previous and of the new export."""
LONGEST_LIST = 1_000_000
"""Maximum size of a file list in bytes. The largest lists have about 5,000."""
_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_./-]+)")
Listed = dict[str, set[str]]


def write_export(folder: str | Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write an export in place of an earlier one. Other files of the folder stay, unless they have the same name.

    Args:
        folder: made when absent.
        files: content by path in the folder, with ``/`` between its parts.

    Returns:
        Paths of the files in their order; plus `LIST`.

    Raises:
        BusyError: another process writes there; nothing was changed.
        StorageError: the folder cannot be written, or a file of the export before was changed since and is not among
            the new ones; then nothing was changed.
    """
    check_kind(folder, "export", what="edp export")
    path = make_folder(folder)
    with _lock_folder(path):
        # The hash is of the content in memory, not of what a full disk made of it.
        new = {file: {hashlib.sha256(data).hexdigest()} for file, data in files.items()}
        old = _read_list(path / LIST), _read_list(path / UNFINISHED)
        every: Listed = {}
        for part in (*old, new):
            for file, digests in part.items():
                every[file] = every.get(file, set()) | digests
        # Only files that an export wrote, and that nobody changed, are removed.
        stale = [file for file in every if file not in new and _ours(path, file, every[file])]
        # Checked before anything is written: a link in the folder could lead anywhere.
        for parent in {(path / file).parent for file in files} - {path}:
            _check_place(path, parent)
        # The list of unfinished files lets the next export clean up after a kill.
        write_bytes(path / UNFINISHED, _write_list(every))
        _remove(path / LIST)
        _clean(path, every)
        for file in stale:
            _remove(path / file)
        _remove_empty(path, stale)
        for file, data in files.items():
            write_bytes(path / file, data)
        # The list comes last: its presence says that all files are whole.
        write_bytes(path / LIST, _write_list(new))
        _remove(path / UNFINISHED)
    return [path / file for file in files]


@contextlib.contextmanager
def _lock_folder(path: Path) -> Iterator[None]:
    try:
        lock = hold(path / ".lock")
    except BusyError as error:
        holder = str(error).rpartition("process ")[2]
        raise BusyError(
            f"folder '{path}' is being written by process {holder}; nothing was changed. Wait for it, or choose "
            "another folder with --out"
        ) from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            (path / ".lock").unlink(missing_ok=True)
        lock.close()


def _read_list(path: Path) -> Listed:
    """Return the files of a list with their permitted hashes; empty if the list is absent or malformed."""
    listed: Listed = {}
    try:
        if is_link_at(path) or not is_file_at(path) or status_of(path).st_size > LONGEST_LIST:
            return listed
        # Characters beyond ASCII cannot match the form of a line, so they need not be an error.
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise storage_error(path, error, "read") from error
    for match in filter(None, map(_LINE.fullmatch, lines)):
        parts = PurePosixPath(match[2]).parts
        # A list is data from the folder: a path out of it must not be followed.
        if not match[2].startswith("/") and ".." not in parts:
            listed.setdefault("/".join(parts), set()).add(match[1])
    return listed


def _write_list(listed: Mapping[str, set[str]]) -> bytes:
    return "".join(f"{digest}  {file}\n" for file in listed for digest in sorted(listed[file])).encode()


def _ours(path: Path, file: str, digests: set[str]) -> bool:
    """Return whether a file of an earlier export is there to be removed.

    Raises:
        StorageError: it is there with another content.
    """
    target = path / file
    if _has_link(path, target) or not is_file_at(target):
        return False
    try:
        digest = hashlib.sha256(target.read_bytes()).hexdigest()
    except OSError as error:
        raise storage_error(target, error, "read") from error
    if digest not in digests:
        raise StorageError(
            f"'{target}' belongs to the export that this folder holds and was changed since; it is none of the new "
            "files, so nothing was written. Move it away, or choose another folder with --out"
        )
    return True


def _has_link(path: Path, target: Path) -> bool:
    """Return whether a path below a folder, or a folder on the way to it, is a symbolic link."""
    steps = target.relative_to(path).parts
    return any(is_link_at(path.joinpath(*steps[: at + 1])) for at in range(len(steps)))


def _check_place(path: Path, target: Path) -> None:
    if _has_link(path, target):
        raise StorageError(
            f"'{target}' is a symbolic link, through which files outside of '{path}' would be written; nothing was "
            "written. Remove it, or choose another folder with --out"
        )


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise storage_error(path, error, "remove") from error


def _clean(path: Path, every: Mapping[str, object]) -> None:
    """Remove the temporary files of a killed export."""
    for folder in {path, *((path / file).parent for file in every)}:
        if is_folder_at(folder) and not (folder != path and _has_link(path, folder)):
            for rest in entries_of(folder):
                if TEMPORARY.fullmatch(rest.name) and is_file_at(rest) and not is_link_at(rest):
                    _remove(rest)


def _remove_empty(path: Path, stale: list[str]) -> None:
    """Remove empty folders."""
    # In reverse order, inner folders come before outer ones.
    for folder in sorted({(path / file).parent for file in stale} - {path}, reverse=True):
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()
