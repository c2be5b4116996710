"""Audit hook, the layer available on every system: Python itself refuses operations that a reader of logs never needs.

It sees what Python code does, not what a compiled library does by itself; for that there are `edp.sandbox.landlock`
and `edp.sandbox.syscalls`.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

_REFUSED = (
    "socket.", "subprocess.", "os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "os.startfile",
    "pty.spawn", "os.kill", "signal.pthread_kill", "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link",
    "os.symlink", "os.chmod", "os.chown", "os.chflags", "os.truncate", "os.utime", "os.setxattr", "os.removexattr",
    "shutil.", "tempfile.", "pickle.", "sqlite3.enable_load_extension", "sqlite3.load_extension", "ftplib.", "http.",
    "imaplib.", "poplib.", "smtplib.", "telnetlib.", "urllib.", "webbrowser.", "winreg.", "resource.prlimit",
)  # fmt: skip
"""Prefixes of the refused audit events. Compiling and executing code is allowed because imports need it."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_OPENERS = {"open", "sqlite3.connect"}
_IN_MEMORY = ":memory:"


def restrict(readable: Iterable[Path]) -> None:
    """Refuse for good to open, from Python, anything for writing, and for reading all but `readable`; and more.

    Raises:
        OSError: the interpreter does not obey the hook.
    """
    sys.addaudithook(hook(readable))
    try:
        sys.audit("socket.__new__")
    except PermissionError:
        return
    raise OSError("the interpreter took the hook and does not obey it")


def hook(readable: Iterable[Path]) -> Callable[[str, tuple[Any, ...]], None]:
    """Return an audit hook that raises PermissionError for refused events."""
    # Real paths: a link below an allowed folder must not lead out of it.
    places = tuple(os.path.realpath(path) for path in readable)
    # With the separator at the end, or /lib would allow /library as well.
    below = tuple(os.path.join(folder, "") for folder in places)

    def judge(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _OPENERS:
            path = arguments[0]
            # The flags of the system's call: they hold however Python's mode was written.
            if event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING:
                raise PermissionError(errno.EPERM, f"a reader of logs may not write files ({path!r})")
            # A number is a handle that is open already, which this process was given.
            if isinstance(path, str | bytes | os.PathLike) and path != _IN_MEMORY:
                real = [os.path.realpath(name) for name in _plain(os.fsdecode(path))]
                if not any(name in places or name.startswith(below) for name in real):
                    raise PermissionError(errno.EPERM, f"a reader of logs may not read other files ({path!r})")
        elif event.startswith(_REFUSED):
            raise PermissionError(errno.EPERM, f"a reader of logs may not do this ({event})")

    return judge


def _plain(path: str) -> list[str]:
    """Return the paths that a name may denote: SQLite URIs occur with and without escapes."""
    if not path.startswith("file:"):
        return [path]
    name = path.removeprefix("file:").partition("?")[0]
    return [name, unquote(name)]
