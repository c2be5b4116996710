"""The command line in this process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from edp.cli import app
from edp.cli.console import run_app


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code and all that it printed, lines joined."""

    code: int
    said: str


@pytest.fixture
def edp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Run a command line: ``edp("inspect", folder)``."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")

    def run(*args: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["edp", *map(str, args)])
        capsys.readouterr()
        code = run_app(app)
        printed = capsys.readouterr()
        return Ended(code, " ".join((printed.out + printed.err).replace("│", " ").split()))

    return run
