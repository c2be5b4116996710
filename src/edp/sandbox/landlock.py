"""Landlock (Linux 5.13 and later): the process may read below some paths, and write nowhere.

Source: the kernel's documentation "Landlock: unprivileged access control" and linux/landlock.h; system calls 444 to
446 have the same numbers on every architecture.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_VERSION = 1
"""Flag to query the Landlock version (ABI) of the kernel."""
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""Number of file rights by the version that introduced them. A kernel refuses unknown bits."""
_NET_FROM, _NET_RIGHTS = 4, 2
"""Version and number of the rights to bind and to connect TCP sockets."""
_SCOPE_FROM, _SCOPES = 6, 3
"""Version that introduced scopes, and their flags: abstract sockets and signals of outside processes."""


def restrict(readable: Iterable[Path]) -> None:
    """Permanently forbid this process to open files for writing, and files other than `readable` for reading.

    Proves the ban on a folder that is not among `readable`.

    Args:
        readable: files, or folders with all below them; missing ones are passed over.

    Raises:
        OSError: the system or the kernel has no Landlock, or does not obey it.
    """
    if not sys.platform.startswith("linux"):
        raise OSError(errno.ENOSYS, "exists on Linux only")
    libc = ctypes.CDLL(None, use_errno=True)
    # Asked first: each version knows more rights, and a kernel refuses bits that it does not know.
    version = _version(libc)
    if version < 1:
        raise _failure("be asked for")
    rights = (1 << max(count for since, count in _FILE_RIGHTS.items() if since <= version)) - 1
    net = (1 << _NET_RIGHTS) - 1 if version >= _NET_FROM else 0
    scopes = _SCOPES if version >= _SCOPE_FROM else 0
    fields = [rights, net, scopes][: 1 + (version >= _NET_FROM) + (version >= _SCOPE_FROM)]
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    rules = libc.syscall(_CREATE, attributes, ctypes.c_size_t(len(attributes)), ctypes.c_uint(0))
    if rules < 0:
        raise _failure("make rules")
    try:
        for path in readable:
            _allow(libc, rules, path)
        # Landlock asks for this of processes without rights: a set-user-id program must not run under foreign rules.
        if libc.prctl(_NO_NEW_PRIVILEGES, *map(ctypes.c_ulong, (1, 0, 0, 0))) or libc.syscall(
            _RESTRICT, ctypes.c_int(rules), ctypes.c_uint(0)
        ):
            raise _failure("take effect")
    finally:
        os.close(rules)
    try:
        handle = os.open(os.sep, os.O_RDONLY)
    except PermissionError:
        return
    os.close(handle)
    raise OSError("the kernel took the rules and does not obey them")


def is_available() -> bool:
    """Return whether the kernel has Landlock."""
    return sys.platform.startswith("linux") and _version(ctypes.CDLL(None, use_errno=True)) >= 1


def _version(libc: ctypes.CDLL) -> int:
    return int(libc.syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint(_VERSION)))


def _allow(libc: ctypes.CDLL, rules: int, path: Path) -> None:
    # A path that this system lacks needs no rule.
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            # A rule on a file with rights of folders is refused by the kernel.
            rights = _READ_FILE | _READ_DIR if path.is_dir() else _READ_FILE
            rule = struct.pack("=Qi", rights, handle)
            if libc.syscall(_ADD, ctypes.c_int(rules), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint(0)):
                raise _failure(f"allow '{path}'")
        finally:
            os.close(handle)


def _failure(doing: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"Landlock cannot {doing} ({os.strerror(number)})")
