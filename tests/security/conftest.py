"""The command line in this process, and the format of hostile files."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.logs import FORMATS
from edp.sandbox import end

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code and all that it printed, lines joined."""

    code: int
    said: str


@pytest.fixture
def edp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Run a command line: ``edp("data", "check", folder)``."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")

    def run(*args: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["edp", *map(str, args)])
        capsys.readouterr()
        code = run_app(app)
        printed = capsys.readouterr()
        return Ended(code, " ".join((printed.out + printed.err).replace("│", " ").split()))

    return run


@pytest.fixture(scope="module")
def hostile_worker() -> Iterator[Any]:
    """The format of files that make their reader do something, known in this module's tests and their worker only."""
    before, served = dict(FORMATS._parts), importlib.import_module("edp.logs.served")
    lock_down = served.lock_down
    sys.path.insert(0, str(HERE))
    hostile_format = importlib.import_module("hostile_format").PART
    served.lock_down = lock_down
    FORMATS._parts.pop("hostile", None)
    end()
    yield hostile_format
    end()
    sys.path.remove(str(HERE))
    FORMATS._parts = before
