"""Differences between systems in opening and locking files: POSIX by `fcntl`, Windows by `msvcrt`."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import sys
from typing import IO

BINARY = getattr(os, "O_BINARY", 0)
"""Flag of `os.open` for binary files. Without it, Windows converts line ends and stops at a Ctrl-Z."""
QUIETLY = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags of `os.open`: do not block, do not become the controlling terminal, do not inherit; 0 on Windows."""
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
HELD = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)
"""Error numbers that report a lock of another process. Windows raises EDEADLK after its last attempt."""
_FAR = 1 << 30
"""Position of the byte that Windows locks. A Windows lock also forbids reading, and the holder's name must stay
readable.
"""

if sys.platform == "win32":  # pragma: no cover - see tests/security/test_portable.py for the same calls
    import msvcrt

    def lock(stream: IO[str], wait: bool = False, shared: bool = False) -> None:
        """Lock an open file for this process; closing it, or the end of the process, frees it."""
        lock_region(msvcrt, stream, wait)

    def lock_handle(handle: int) -> None:
        """Refuse: files that are being written are not held on Windows."""
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
else:
    import fcntl

    def lock_handle(handle: int) -> None:
        """Lock an open folder, or a file that is open for writing, for this process; closing the handle frees it.

        Raises:
            OSError: another process holds it, or the file system has no locks.
        """
        # A file by a record lock: HDF5 takes the other kind itself and would find its own file locked.
        lock_kind = fcntl.flock if stat.S_ISDIR(os.fstat(handle).st_mode) else fcntl.lockf
        lock_kind(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def lock(stream: IO[str], wait: bool = False, shared: bool = False) -> None:
        """Lock an open file for this process; closing it, or the end of the process, frees it.

        Args:
            stream: stream of a file that is open for writing, or for reading if `shared`.
            wait: whether to wait for another holder.
            shared: whether other processes may hold a shared lock as well.

        Raises:
            OSError: another process holds it (`HELD`), or the file system has no locks.
        """
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        fcntl.flock(stream, kind | (0 if wait else fcntl.LOCK_NB))


def hold_handle(handle: int) -> None:
    """Show that this process is writing a file; without effect where the system or the file system has no locks."""
    with contextlib.suppress(OSError):
        lock_handle(handle)


def lock_region(msvcrt_module: object, stream: IO[str], wait: bool) -> None:
    """Lock a file on Windows: one byte far after the content; the stream position is restored.

    Windows has no shared locks here, so that two processes that only ask who holds a file may meet; the second
    is then told the last holder. `wait` tries for ten seconds at a time.
    """
    handle = stream.fileno()
    offset = os.lseek(handle, 0, os.SEEK_CUR)
    try:
        while True:
            os.lseek(handle, _FAR, os.SEEK_SET)
            try:
                msvcrt_module.locking(handle, msvcrt_module.LK_LOCK if wait else msvcrt_module.LK_NBLCK, 1)  # type: ignore[attr-defined]
            except OSError as error:
                if wait and error.errno in HELD:
                    continue
                raise
            return
    finally:
        os.lseek(handle, offset, os.SEEK_SET)


def cores() -> int:
    """Return the number of processors available to this process, which may be fewer in a container."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
