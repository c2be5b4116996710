"""`make check` starts no process: tests that do are marked `processes` and left out, and a forgotten one fails.

A test is marked by hand, with its file, by its folder, or by a fixture that starts processes. The guard is an audit
hook of Python (`sys.addaudithook`), which sees every way to start a process but `_posixsubprocess.fork_exec` of
`multiprocessing`; that one is replaced.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NoReturn

import pytest

HERE = Path(__file__).parents[1]
FOLDERS = ("examples", "export", "fuzz", "golden", "parity", "properties", "security", "unit/cli")
"""Whose tests run compilers, commands and workers, or belong to no quick check."""
FIXTURES = frozenset({"edp", "lever_sessions", "six_sessions"})
"""Reading a log starts the sandbox of the readers, and all of these read logs."""
LEFT_OUT = re.compile(r"^pytestmark = .*\bmark\.(processes|long)\b", re.MULTILINE)
"""Mark of a file whose tests start processes, train networks or draw pages."""
EVENTS = frozenset(
    ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system", "os.exec", "pty.spawn")
)
_watched: list[bool] = []
_installed: list[bool] = []


class ProcessStartedError(BaseException):
    """A test of the quick check starts a process; a base exception, so that no test takes it for a result."""


def starts_processes(item: pytest.Item) -> bool:
    """Whether a test's folder or one of its fixtures starts processes."""
    return _in_folders(place_of(item)) or bool(FIXTURES & set(getattr(item, "fixturenames", ())))


def leaves_out(path: Path) -> bool:
    """Whether no test of a file belongs to the quick check: it need not be imported, nor what it imports."""
    place = path.relative_to(HERE).as_posix() if path.is_relative_to(HERE) and path.suffix == ".py" else ""
    return _in_folders(place) or (bool(place) and LEFT_OUT.search(path.read_text(encoding="utf-8")) is not None)


def _in_folders(place: str) -> bool:
    return place.startswith(tuple(f"{folder}/" for folder in (*FOLDERS, "unit/api"))) and not place.endswith(
        "conftest.py"
    )


def place_of(item: pytest.Item) -> str:
    """Of a test's file below `tests`; empty where it lies elsewhere."""
    return _place_of(item.path)


@cache  # a file has thousands of tests
def _place_of(path: Path) -> str:
    return path.relative_to(HERE).as_posix() if path.is_relative_to(HERE) else ""


def install() -> None:
    """Put the guard in place; it acts inside `watching` only, since pytest itself starts workers."""
    if _installed:
        return
    _installed.append(True)
    # Bound as defaults: the hook outlives this module's names when Python ends.
    sys.addaudithook(lambda event, _, events=EVENTS, on=_watched: _refuse(event) if on and event in events else None)
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
