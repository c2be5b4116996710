"""Options that have no effect without, or beside, another one: refused before anything is read, in every command."""

import sys

import pytest
from typer.main import get_command

from edp.cli import app
from edp.cli.console import run_app
from edp.cli.options import EXCLUDED, OWNERS


def leaves(node, words=()):
    below = getattr(node, "commands", None)
    if below is None:
        yield " ".join(words), {parameter.name: parameter for parameter in node.params}
    else:
        for name, inner in below.items():
            yield from leaves(inner, (*words, name))


COMMANDS = dict(leaves(get_command(app)))
WITHOUT = [
    (command, name, owners)
    for (where, name), owners in OWNERS.items()
    for command, parameters in COMMANDS.items()
    if where == command or (where == "*" and name in parameters)
]
BESIDE = [(command, name, other) for (command, name), others in EXCLUDED.items() for other in others]


@pytest.fixture
def edp(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["edp", *words])
        code = run_app(app)
        return code, " ".join(capsys.readouterr().err.split()), sorted(path.name for path in tmp_path.iterdir())

    return run


def called(command, *names):
    """A command line with what the command asks for and the parameters of these names."""
    words = command.split()
    for name, parameter in COMMANDS[command].items():
        option = parameter.param_type_name == "option"
        if parameter.required or name in names:
            words += [parameter.opts[0]] if option else []
            if not getattr(parameter, "is_flag", False):
                words.append({"delta_kb": "16", "units": "16", "repair": "nan=hold"}.get(name, "there"))
    return words


def word(command, name):
    return COMMANDS[command][name].opts[0]


def test_rules_name_parameters_of_commands():
    for (where, name), others in (*OWNERS.items(), *EXCLUDED.items()):
        for command in COMMANDS if where == "*" else (where,):
            if where != "*" or name in COMMANDS[command]:
                assert {name, *others} <= set(COMMANDS[command]), (command, name)


@pytest.mark.parametrize(("command", "name", "owners"), WITHOUT)
def test_an_option_without_its_owner_is_refused(command, name, owners, edp):
    code, err, left = edp(*called(command, name))
    assert code == 1
    assert f"error: {word(command, name)}: it has no effect without" in err
    assert all(word(command, owner) in err for owner in owners)
    assert left == []


@pytest.mark.parametrize(("command", "name", "owners"), WITHOUT)
def test_an_option_beside_its_owner_is_taken(command, name, owners, edp):
    _, err, _ = edp(*called(command, name, owners[0]))
    assert "has no effect without" not in err


@pytest.mark.parametrize(("command", "name", "other"), BESIDE)
def test_an_option_beside_one_that_takes_its_effect_is_refused(command, name, other, edp):
    code, err, left = edp(*called(command, name, other))
    assert code == 1
    assert f"error: {word(command, other)}: it has no effect beside {word(command, name)}" in err
    assert left == []


def test_a_map_and_repairs_belong_to_logs_in_every_command():
    """A later command whose logs are optional must say to which option its map belongs."""
    for command, parameters in COMMANDS.items():
        logs = [parameters[name] for name in ("data", "logs", "log") if name in parameters]
        if "signal_map" in parameters and not any(parameter.required for parameter in logs):
            assert command in FREE or (command, "signal_map") in OWNERS, command


FREE = {
    "live": "each source declares its options",
    "animate": "its log is one of several paths",
    "monitor fit": "its logs are the last of several paths",
    "finetune": "refused beside --fleet by the command",
}
