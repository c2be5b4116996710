"""`edp verify` compiles and runs code of a bundle: of one from elsewhere it asks first."""

from __future__ import annotations

import sys

import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.workflows.parity import from_own_run


@pytest.fixture
def parity(monkeypatch, capsys):
    """Runs the command up to the point where it would read the bundle, which is none; exit code and errors."""
    monkeypatch.setenv("COLUMNS", "400")

    def run(*args: object, terminal: bool = False, answer: bool = False) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["edp", "verify", *map(str, args)])
        monkeypatch.setattr(sys.stdin, "isatty", lambda: terminal, raising=False)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
        monkeypatch.setattr("typer.confirm", lambda *_, **__: answer)
        code = run_app(app)
        return code, " ".join(capsys.readouterr().err.split())

    return run


def test_a_lone_bundle_is_not_run_without_a_word(parity, tmp_path):
    code, said = parity(tmp_path)
    assert code == 1
    assert "compiles it and runs it on this computer" in said
    assert "--yes" in said
    assert "is not a bundle" not in said  # nothing was read yet


def test_yes_goes_on(parity, tmp_path):
    assert "is not a bundle" in parity(tmp_path, "--yes")[1]


def test_a_terminal_is_asked(parity, tmp_path):
    assert "is not a bundle" in parity(tmp_path, terminal=True, answer=True)[1]
    refused = parity(tmp_path, terminal=True)[1]
    assert "nothing was run" in refused
    assert "is not a bundle" not in refused


@pytest.mark.parametrize("name", ["run.json", "provenance.json"])
def test_run_folders_and_their_bundles_are_ones_own(parity, tmp_path, name):
    (tmp_path / "bundle").mkdir()
    (tmp_path / "other").mkdir()
    assert not from_own_run(tmp_path)
    (tmp_path / name).write_text("{}")
    assert from_own_run(tmp_path)
    assert from_own_run(tmp_path / "bundle")
    assert not from_own_run(tmp_path / "other")
    unfinished = "holds a run that is not finished" if name == "run.json" else "it has no bundle.json"
    assert unfinished in parity(tmp_path)[1]
