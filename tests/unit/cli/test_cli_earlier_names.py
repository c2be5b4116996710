"""Names of commands and options in earlier versions are read; one line on standard error gives the new name."""

import pytest
from typer.main import get_command

from edp.cli import app
from edp.cli.names import COMMANDS, OPTIONS, rewrite


def found(words):
    node = get_command(app)
    for word in words:
        node = node.commands[word]
    return node


def test_every_new_name_is_a_command_or_group():
    for words in (*COMMANDS.values(), *OPTIONS):
        assert found(words)


@pytest.mark.parametrize("words", OPTIONS)
def test_every_new_option_exists_and_no_earlier_one_does_unless_it_means_something_else(words):
    command = found(words)
    command = command.commands["run"] if hasattr(command, "commands") else command
    options = {name for parameter in command.params for name in parameter.opts}
    for old, new in OPTIONS[words].items():
        assert new.name in options
        assert old not in options


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("inspect logs --at-most 2", "data check logs --max-hours 2"),
        ("store check x", "data store verify x"),
        ("store build x --out y", "data store build x --out y"),
        ("compress run --budget b.toml --out x", "compress search run --budget b.toml --out x"),
        ("train data --out x --minutes 5", "train data --out x --time-budget 5min"),
        ("train data --out x --minutes=5", "train data --out x --time-budget=5min"),
        ("train --focus simulation data --minutes 5", "twin data --time-budget 5min"),
        ("train data --focus=simulation", "twin data"),
        ("twin data --minutes 3", "twin data --time-budget 3min"),
        ("tune r --on t --seeds 2 --loops 3", "loop tune r --tuning-plant t --evaluation-loops 2 --tuning-loops 3"),
        ("search status s", "search status s"),
        ("search logs --study s", "search logs --out s"),
        ("parity r --form c --ticks 9", "verify r --format c --samples 9"),
    ],
)
def test_a_command_line_of_an_earlier_version_is_rewritten(given, expected):
    assert rewrite(given.split()).words == expected.split()


def test_an_earlier_name_prints_one_line_on_standard_error(edp, logs):
    ended = edp("inspect", logs, "--no-coverage", "--json")
    assert ended.json == edp("data", "check", logs, "--no-coverage", "--json").json
    assert ended.err.count("note: edp inspect is now edp data check") == 1


def test_present_names_print_no_notice(edp, logs):
    assert "is now" not in edp("data", "check", logs, "--no-coverage").err


def test_a_time_without_a_unit_is_refused(edp, tmp_path):
    ended = edp("simulate", tmp_path / "x", "--duration", "5")
    assert ended.code == 2
    assert "'--duration': got '5', expected a number with a unit" in ended.err


@pytest.mark.parametrize(("value", "new"), [("5", "5min"), ("1h", "1h"), ("x", "x"), ("--out", "--out")])
def test_only_a_number_gets_the_unit_of_an_earlier_option(value, new):
    assert rewrite(["simulate", "logs", "--minutes", value]).words == ["simulate", "logs", "--duration", new]
    assert rewrite(["simulate", "logs", f"--minutes={value}"]).words == ["simulate", "logs", f"--duration={new}"]


@pytest.mark.parametrize("preset", ["auto", "quick"])
def test_both_names_of_a_key_in_two_overrides_are_an_error(edp, logs, tmp_path, preset):
    given = ("--set", "judge.skip=5", "--set", "evaluation.warmup_samples=4")
    ended = edp("train", logs, "--preset", preset, "--out", tmp_path / "run", *given)
    assert ended.code == 1
    assert "'judge' is now 'evaluation', and both are given" in ended.err
