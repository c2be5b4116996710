"""A run that is not finished: one message for every command that opens a run."""

import json

import pytest
from typer.main import get_command

from edp.cli import app
from edp.storage.runs import Run

ARGUMENTS = {
    "evaluate": ("{run}",),
    "rollout": ("{run}", "{log}"),
    "data add-forecasts": ("{run}", "{log}", "--out", "{out}"),
    "live": ("{run}", "--log", "{log}"),
    "compress distil": ("{run}", "--units", "4", "--out", "{out}"),
    "compress search": ("{run}", "--out", "{out}"),
    "train finetune": ("{run}", "{log}", "--out", "{out}"),
    "adapt run": ("{run}", "--out", "{out}"),
    "adapt replay": ("{run}", "{log}"),
    "compress estimate": ("{run}",),
    "export": ("{run}", "--format", "c", "--out", "{out}"),
    "verify": ("{run}",),
    "compress quantise": ("{run}", "--out", "{out}"),
    "report": ("{run}",),
    "compare": ("{run}", "{other}"),
    "fleet report": ("{run}", "{log}", "--out", "{out}"),
    "registry add": ("{out}", "{run}", "--name", "first"),
    "monitor fit": ("{run}", "{log}", "--out", "{out}"),
}
"""How each command that opens a run is called; the help of its arguments says which commands these are."""
WRITES = {"loop run", "loop tune"}
"""Commands whose run folder is the one that they write."""


def opening_commands():
    """Return the commands with an argument whose help speaks of a run folder, from the tree of commands."""
    found, waiting = set(), [("", get_command(app))]
    while waiting:
        name, command = waiting.pop()
        waiting += [(f"{name} {sub}".strip(), one) for sub, one in getattr(command, "commands", {}).items()]
        helps = [getattr(p, "help", "") or "" for p in command.params if p.param_type_name == "argument"]
        if any("run folder" in text.lower() for text in helps):
            found.add(name)
    return found - WRITES


def test_every_command_that_opens_a_run_is_called_here():
    assert opening_commands() == set(ARGUMENTS)


@pytest.fixture
def stopped(tmp_path):
    with Run(tmp_path / "stopped") as folder:
        folder.claim("0" * 32, "seed = 0\n")
        folder.write_status("running")
    return tmp_path / "stopped"


@pytest.mark.parametrize("command", sorted(ARGUMENTS))
def test_a_stopped_run_is_named_as_such(edp, logs, stopped, tmp_path, command):
    names = {"run": stopped, "out": tmp_path / "out", "log": next(logs.iterdir()), "other": stopped}
    if command == "compare":
        names["other"] = tmp_path / "other"
        names["other"].mkdir()
    words = [word.format(**names) for word in ARGUMENTS[command]]
    ended = edp(*command.split(), *words)
    assert f"'{stopped}' holds a run that is not finished (it was stopped)" in ended.out + ended.err
    assert ended.code == (0 if command == "report" else 1)


def test_a_run_that_is_being_written_is_waited_for(edp, stopped):
    with Run(stopped):
        assert "is at work); wait until it ends" in edp("evaluate", stopped).err


def test_a_run_killed_before_its_identity_is_unfinished_too(edp, stopped):
    (stopped / "run.json").unlink()
    (stopped / "status.json").unlink()
    assert "not finished" in edp("evaluate", stopped).err
    (stopped / ".lock").unlink()
    assert "is not a bundle" in edp("evaluate", stopped).err


def test_a_finished_run_without_its_result_is_not_called_unfinished(edp, stopped):
    (stopped / "status.json").write_text(json.dumps({"status": "finished", "time": ""}))
    assert "is not a bundle" in edp("evaluate", stopped).err
