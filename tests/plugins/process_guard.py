"""`make check` starts no process: tests that do are marked `processes` and left out, and a forgotten one fails.

A test is marked by hand, by its folder, or by a fixture that starts processes. The guard is an audit hook of Python
(`sys.addaudithook`), which sees every way to start a process but `_posixsubprocess.fork_exec` of `multiprocessing`;
that one is replaced.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

HERE = Path(__file__).parents[1]
FOLDERS = ("examples", "export", "fuzz", "golden", "parity", "properties", "security", "unit/cli")
"""Whose tests run compilers, commands and workers, or belong to no quick check."""
FIXTURES = frozenset({"edp", "lever_sessions", "six_sessions"})
"""Reading a log starts the sandbox of the readers, and all of these read logs."""
EVENTS = frozenset(
    ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system", "os.exec", "pty.spawn")
)
_watched: list[bool] = []
_installed: list[bool] = []


class ProcessStartedError(BaseException):
    """A test of the quick check starts a process; a base exception, so that no test takes it for a result."""


def starts_processes(item: pytest.Item) -> bool:
    """Whether a test's folder or one of its fixtures starts processes."""
    place = item.path.relative_to(HERE).as_posix() if item.path.is_relative_to(HERE) else ""
    return place.startswith(tuple(f"{folder}/" for folder in FOLDERS)) or bool(
        FIXTURES & set(getattr(item, "fixturenames", ()))
    )


def install() -> None:
    """Put the guard in place; it acts inside `watching` only, since pytest itself starts workers."""
    if _installed:
        return
    _installed.append(True)
    sys.addaudithook(lambda event, _: _refuse(event) if event in EVENTS and _watched else None)
    if sys.platform != "win32":
        import _posixsubprocess

        plain = _posixsubprocess.fork_exec
        _posixsubprocess.fork_exec = lambda *args: _refuse("fork_exec") if _watched else plain(*args)


def _refuse(event: str) -> NoReturn:
    raise ProcessStartedError(f"{event}: `make check` starts no process; mark this test with pytest.mark.processes")


@contextlib.contextmanager
def watching() -> Iterator[None]:
    """While a test runs, with its fixtures."""
    _watched.append(True)
    try:
        yield
    finally:
        _watched.pop()
