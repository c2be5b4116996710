"""Checks of paths: existence, type, size and entries of files and folders.

A user's path cannot always be looked at: no permission, too long a name, a loop of links, a NUL character, a network
drive that is gone. `pathlib` raises some of these errors and hides others, differently in each version of Python. Here
something is at a path, or nothing is, or the path is refused with one message. All of EDP looks at paths this way.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from edp.errors import StorageError

_ABSENT = (errno.ENOENT, errno.ENOTDIR)
"""Error numbers of a path that does not exist."""
_LONGEST = 200
"""Maximum number of characters of a path in a message."""


def status_at(path: str | Path, follow: bool = True) -> os.stat_result | None:
    """Return the file status of a path; None if the path does not exist.

    Args:
        path: path of a file, a folder or anything else.
        follow: whether to follow a symbolic link at the end of the path.

    Raises:
        StorageError: the path cannot be looked at.
    """
    try:
        return os.stat(path, follow_symlinks=follow)
    except OSError as error:
        if error.errno in _ABSENT or getattr(error, "winerror", None) in (123, 161):
            return None
        raise cannot_look(path, error) from error
    except ValueError as error:  # a NUL in the path
        raise cannot_look(path, error) from error


def status_of(path: str | Path) -> os.stat_result:
    """Return the file status of a path after following symbolic links.

    Raises:
        StorageError: nothing is there, or the path cannot be looked at.
    """
    status = status_at(path)
    if status is None:
        raise StorageError(f"'{_format_path(path)}' is not there: removed or renamed; give a path that exists")
    return status


def is_there(path: str | Path) -> bool:
    """Return whether anything is at a path, after symbolic links are followed.

    Raises:
        StorageError: the path cannot be looked at.
    """
    return status_at(path) is not None


def is_file_at(path: str | Path) -> bool:
    """Return whether a regular file is at a path, after symbolic links are followed.

    Raises:
        StorageError: the path cannot be looked at.
    """
    status = status_at(path)
    return status is not None and stat.S_ISREG(status.st_mode)


def is_folder_at(path: str | Path) -> bool:
    """Return whether a folder is at a path, after symbolic links are followed.

    Raises:
        StorageError: the path cannot be looked at.
    """
    status = status_at(path)
    return status is not None and stat.S_ISDIR(status.st_mode)


def is_entry_at(path: str | Path) -> bool:
    """Return whether a folder has an entry of this name, be it a link that leads nowhere.

    Raises:
        StorageError: the path cannot be looked at.
    """
    return status_at(path, follow=False) is not None


def is_link_at(path: str | Path) -> bool:
    """Return whether a symbolic link is at a path.

    Raises:
        StorageError: the path cannot be looked at.
    """
    status = status_at(path, follow=False)
    return status is not None and stat.S_ISLNK(status.st_mode)


def size_at(path: str | Path) -> int:
    """Return the size of a regular file in bytes, or -1 for links, folders and missing paths.

    Raises:
        StorageError: the path cannot be looked at.
    """
    status = status_at(path, follow=False)
    return status.st_size if status is not None and stat.S_ISREG(status.st_mode) else -1


def entries_of(folder: str | Path, pattern: str = "*") -> list[Path]:
    """Return the paths in a folder whose names fit a pattern, sorted; an empty list if no folder is there.

    Raises:
        StorageError: the folder cannot be listed.
    """
    try:
        names = os.listdir(folder)
    except OSError as error:
        if error.errno in _ABSENT:
            return []
        raise cannot_look(folder, error, "listed") from error
    except ValueError as error:
        raise cannot_look(folder, error, "listed") from error
    return [Path(folder, name) for name in sorted(names) if fnmatchcase(name, pattern)]


def files_below(folder: str | Path, pattern: str = "*") -> Iterator[Path]:
    """Yield the regular files below a folder whose names fit a pattern. Links to folders are not followed.

    Raises:
        StorageError: a folder cannot be listed, or an entry cannot be looked at.
    """
    waiting = [Path(folder)]
    while waiting:
        top = waiting.pop()
        below = []
        for entry in entries_of(top):
            status = status_at(entry, follow=False)
            if status is None:  # removed since
                continue
            if stat.S_ISDIR(status.st_mode):
                below.append(entry)
            elif fnmatchcase(entry.name, pattern) and _leads_to_file(entry, status):
                yield entry
        waiting += reversed(below)


def _leads_to_file(entry: Path, status: os.stat_result) -> bool:
    """Return whether an entry is a regular file, or a link to one; a link in a loop leads nowhere, too."""
    try:
        return stat.S_ISREG(status.st_mode) or (stat.S_ISLNK(status.st_mode) and is_file_at(entry))
    except StorageError as error:
        if getattr(error.__cause__, "errno", None) == errno.ELOOP:
            return False
        raise


def full_path(path: str | Path) -> Path:
    """Return the absolute path without links and ``..``.

    Raises:
        StorageError: the path leads in a loop of links, or holds a NUL character.
    """
    try:
        return Path(path).resolve()
    except RuntimeError as error:  # what Python up to 3.12 raises for a loop
        raise cannot_look(path, OSError(errno.ELOOP, os.strerror(errno.ELOOP))) from error
    except (OSError, ValueError) as error:
        raise cannot_look(path, error) from error


def cannot_look(path: str | Path, error: OSError | ValueError, looked: str = "looked at") -> StorageError:
    """Return the error for a path that cannot be inspected."""
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    advice = {
        errno.EACCES: "ask its owner for the right to read it, or give another path",
        errno.EPERM: "ask its owner for the right to read it, or give another path",
        errno.ENAMETOOLONG: "give a shorter path",
        errno.ELOOP: "remove the loop of links, or give another path",
    }.get(getattr(error, "errno", 0) or 0, "see that its disk is there, or give another path")
    return StorageError(f"'{_format_path(path)}' cannot be {looked}: {reason}; {advice}")


def _format_path(path: str | Path) -> str:
    text = str(path)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
