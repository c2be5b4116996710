"""Options that have no effect without, or beside, another one: refused before anything is read, in every command."""

import shlex
import sys

import pytest
from typer.main import get_command

from edp.cli import app
from edp.cli.console import run_app
from edp.cli.options import DEPENDENT, EXCLUDED, OWNERS, TRIAL_TABLES
from edp.config.commands import TRAINING_TABLES
from edp.control.controllers import CONTROLLERS


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


VALUES = {"delta_kb": "16", "units": "16", "repair": "nan=hold", "split": "time", "max_runs": "5"}
"""Values of parameters that take no path."""


def called(command, *names):
    """A command line with what the command asks for and the parameters of these names."""
    words = command.split()
    for name, parameter in COMMANDS[command].items():
        option = parameter.param_type_name == "option"
        if parameter.required or name in names:
            words += [option_word(parameter)] if option else []
            if not getattr(parameter, "is_flag", False):
                words.append(
                    {"delta_kb": "16", "units": "16", "repair": "nan=hold", "split": "time", "max_runs": "5"}.get(
                        name, "there"
                    )
                )
    return words


def option_word(parameter):
    """The switch that changes the default, or the option."""
    return parameter.secondary_opts[0] if parameter.default is True else parameter.opts[0]


def word(command, name):
    return option_word(COMMANDS[command][name])


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


FREE_RUNS = {"twin/twin.json": "{}", "free_run.json": "{}"}
LINES = {
    ("data animate", "horizon"): "data animate there --horizon 3",
    **{
        ("evaluate", name): f"evaluate twin_run {option}"
        for name, option in {
            "baselines": "--baselines ridge",
            "time_budget": "--time-budget 5min",
            "max_hours": "--max-hours 2",
            "channel_importance": "--channel-importance",
            "workers": "--workers 2",
            "cluster": "--cluster there:1",
        }.items()
    },
    ("evaluate", "predictor"): "evaluate run --predictor there",
    (
        "monitor fit",
        "time_budget",
    ): """monitor fit there --out new --time-budget 3min --set 'residuals=[{kind="balances"}]'""",
    ("verify", "interpreters"): "verify run --format c --onnxruntime there",
    ("train pretrain", "changes.pretrain"): "train pretrain there --out new --set pretrain.shots=4",
    ("report", "limit"): "report twin_run --limit there",
    ("report", "budget"): "report twin_run --budget there",
    **{
        ("data screen", f"changes.{table}"): f"data screen there --out new --set {table}.any=1"
        for table in TRIAL_TABLES
    },
    ("search run", "budget"): "search there --out new --budget budget.toml --set search.compression.enabled=false",
    ("simulate", "changes.limit"): "simulate new --set limit.moments=60",
    ("train run", "time_budget"): "train there --out new --preset quick --time-budget 5min",
    ("train run", "workers"): "train there --out new --preset quick --workers 2",
    ("train run", "cluster"): "train there --out new --preset quick --cluster there:1",
    ("twin", "time_budget"): "twin there --out new --set twin.kind=recurrent --time-budget 5min",
    ("twin", "workers"): "twin there --out new --set twin.kind=static --workers 2",
    ("twin", "cluster"): "twin there --out new --set twin.kind=static --cluster there:1",
}
"""A command line for each option of `DEPENDENT`, with settings or files by which it has no effect."""
MORE_LINES = [
    (("evaluate", "time_budget"), "evaluate run --time-budget 5min --workers 2"),
    (("evaluate", "time_budget"), "evaluate run --time-budget 5min --baselines none"),
    (("simulate", "changes.limit"), "simulate new --set seed=3 --set limit={moments=4}"),
    (("train run", "workers"), "train there --out new --workers 2 --set training.epochs=3"),
    (("twin", "time_budget"), "twin there --out new --start there --time-budget 5min"),
    (("twin", "workers"), "twin there --out new --set ground=drag --start there --workers 2"),
    (("twin", "workers"), "twin there --out new --set twin.kind=greybox --workers 2"),
]


def test_every_dependent_option_has_a_command_line():
    assert set(LINES) == set(DEPENDENT)
    assert {"trials", *TRAINING_TABLES} == set(TRIAL_TABLES)


@pytest.mark.parametrize(("option", "line"), [*LINES.items(), *MORE_LINES])
def test_an_option_without_effect_by_settings_or_files_is_refused(option, line, edp, tmp_path):
    for name, content in FREE_RUNS.items():
        file = tmp_path / "twin_run" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    (tmp_path / "run").mkdir()
    (tmp_path / "budget.toml").write_text("")
    (command, name), words = option, shlex.split(line)
    code, err, left = edp(*words)
    parameter, _, table = name.partition(".")
    said = f"{word(command, parameter)} {table}" if table else f"{word(command, parameter)}: it"
    assert code == 1
    assert f"error: {said}" in err
    assert f"it has no effect without {DEPENDENT[option]}; leave" in err
    assert err.count("error:") == 1
    assert left == ["budget.toml", "run", "twin_run"]


@pytest.mark.parametrize("kind", list(CONTROLLERS))
@pytest.mark.parametrize("command", ["loop run new", "loop tune new", "live --loop grade"])
def test_a_model_that_no_part_of_the_controller_uses_is_refused(kind, command, edp):
    """Every registered controller: each model that it does not need, and the second of two alternatives."""
    needs = " ".join(CONTROLLERS[kind].needs).split()
    unused = [[f"--{name}", "there"] for name in ("twin", "predictor") if name not in needs]
    if "or" in needs:
        unused.append(["--predictor", "there", "--twin", "there"])
    for words in unused:
        code, err, left = edp(*command.split(), "--controller", kind, *words)
        assert code == 1
        assert f"error: {words[-2]}: it has no effect with the controller '{kind}'" in err
        assert left == []


def test_a_map_and_repairs_belong_to_logs_in_every_command():
    """A later command whose logs are optional must say to which option its map belongs."""
    for command, parameters in COMMANDS.items():
        logs = [parameters[name] for name in ("data", "logs", "log") if name in parameters]
        if "signal_map" in parameters and not any(parameter.required for parameter in logs):
            assert command in FREE or (command, "signal_map") in OWNERS, command


FREE = {
    "live": "each source declares its options",
    "data animate": "its log is one of several paths",
    "monitor fit": "its logs are the last of several paths",
    "train finetune": "refused beside --fleet by the command",
}
