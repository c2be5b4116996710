"""A command whose folder another process holds is refused before it reads any data."""

import pytest
from typer.main import get_command

from edp.cli import app
from edp.logs.source import DataSource
from edp.storage.locks import hold

from .test_cli_options import leaves

COMMANDS = dict(leaves(get_command(app)))
CLAIMING = {
    "train run": (".lock", "is in use by process"),
    "compress distil": (".lock", "is in use by process"),
    "compress search": (".lock", "is in use by process"),
    "compress quantise": (".lock", "is in use by process"),
    "adapt run": (".lock", "is in use by process"),
    "train finetune": (".lock", "is in use by process"),
    "train pretrain": (".lock", "is in use by process"),
    "twin": (".lock", "is in use by process"),
    "loop run": (".lock", "is in use by process"),
    "loop tune": (".lock", "is in use by process"),
    "monitor fit": (".lock", "is in use by process"),
    "search run": ("ledger/.lock", "is coordinated by process"),
}
"""Lock file of each command that claims its folder, and what the refusal says."""
NOT_CLAIMING = {
    "report": "writes one page at its end, from files that are finished",
    "compare": "writes one page at its end",
    "search report": "writes pages and tables of a study, from files that are finished",
    "search export": "writes one journal at its end",
    "monitor report": "writes one page at its end",
    "monitor run": "writes its few files at its end, each replaced as a whole",
    "data animate": "writes one page or film at its end",
    "rollout": "writes one table at its end",
    "calibrate": "writes one machine file, which must not exist before",
    "init": "writes two files in a moment",
    "export": "replaces the folder of an export as a whole at its end",
    "data add-forecasts": "writes a new folder, refused where it exists",
    "data screen": "writes pages and figures at its end, and keeps no state to go on from",
    "fleet report": "writes pages at its end",
    "fleet network": "writes a bundle as a whole at its end",
    "data store build": "is a store with a lock of its own, not a run",
    "demo": "makes its data first; its run is that of edp train, which claims",
}
"""Commands with ``--out`` that hold no run folder, each with the reason."""
ARGUMENTS = {"monitor fit": ("logs",), "train finetune": ("source", "logs"), "loop run": (), "loop tune": ()}
DATA = {"train run", "twin", "train pretrain", "search run"}
"""Commands whose first argument is logs."""
FURTHER = {"compress distil": ("--units", 4)}
"""Options without which a command is refused at once."""
FOLDER = {"loop run": (), "loop tune": (), "search run": ("--out",)}
"""How the folder is given, where it is not ``--out``."""


def test_every_command_with_a_folder_is_declared_once():
    with_out = {
        name
        for name, parameters in COMMANDS.items()
        if any("--out" in parameter.opts for parameter in parameters.values())
    }
    assert sorted(with_out | set(FOLDER)) == sorted([*CLAIMING, *NOT_CLAIMING])


def test_every_argument_that_names_a_run_folder_to_write_is_declared():
    writing = {
        name
        for name, parameters in COMMANDS.items()
        for parameter in parameters.values()
        if parameter.param_type_name == "argument" and "Run folder to write" in (getattr(parameter, "help", "") or "")
    }
    assert writing <= set(CLAIMING)


@pytest.mark.parametrize("command", sorted(CLAIMING))
def test_a_folder_in_use_is_refused_before_data_are_read(command, edp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "log.csv").write_text("time,a,b\n0,1,2\n1,2,3\n2,3,4\n")

    def read(self):
        pytest.fail("data are read before the folder is claimed")

    monkeypatch.setattr(DataSource, "read", read)
    file, message = CLAIMING[command]
    lock = tmp_path / "out" / file
    lock.parent.mkdir(parents=True)
    first = ARGUMENTS.get(command, ("logs",) if command in DATA else ("run",))
    words = [*command.split(), *first, *FOLDER.get(command, ("--out",)), "out", *FURTHER.get(command, ())]
    with hold(lock):
        ended = edp(*words)
    assert message in " ".join(ended.err.split()), ended
    assert ended.code == 75
