"""Numbers and paths on the command line: what cannot be ends in one message and code 1 or 2, in every command."""

import inspect
import sys
import typing
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.models import OptionInfo, ParameterInfo

from edp.cli import app
from edp.cli.console import PATH_OPTIONS, run_app

EXTREMES = ("-1", "0", "1e9", "1000000000000", "9" * 6000, "nan", "1e400", "")
APART = {"simulate", "demo"}
"""Their numbers are tested with the simulator's."""
ALWAYS_WRONG = {
    ("distil", "--units"): ("-1", "0", "1000000000000"),
    ("distil", "--levels"): ("-1", "0", "1000"),
    ("distil", "--truth"): ("-1", "nan", "inf"),
    ("distil", "--hint"): ("-1", "nan", "inf"),
    ("pretrain", "--inner-rate"): ("-1", "0", "nan", "inf"),
    ("pretrain", "--inner-steps"): ("-1", "0", "1000000000000"),
    ("pretrain", "--shots"): ("-1", "0", "1000000000000"),
    ("finetune", "--epochs"): ("-1", "0", "1000000000000"),
    ("finetune", "--head-rate"): ("-1", "nan", "inf"),
    ("finetune", "--batch"): ("-1", "0", "1000000000000"),
    ("finetune", "--smoothness"): ("-1", "nan", "inf"),
    ("finetune", "--weight-decay"): ("-1", "nan", "inf"),
    ("finetune", "--patience"): ("-1", "1000000000000"),
    ("finetune", "--rank"): ("-1", "0", "1000000000000"),
    ("finetune", "--soft"): ("-1", "nan", "2"),
    ("finetune", "--inner-rate"): ("-1", "nan", "inf"),
    ("adapt", "--rank"): ("-1", "1000000000000"),
    ("adapt", "--noise"): ("-1", "nan", "inf"),
    ("adapt", "--dead-zone"): ("-1", "nan", "inf"),
    ("quantise", "--ticks"): ("-1", "0", "1000000000000"),
    ("compress", "--units"): ("-1", "0", "1000000000000"),
    ("search run", "--workers"): ("-1", "1000000000000"),
    ("search run", "--threads"): ("-1", "0", "1000000000000"),
    ("search run", "--seconds"): ("-1", "0", "nan", "inf"),
    ("search run", "--memory"): ("-1", "0", "nan", "inf"),
}


def walk(group, path=()):
    """The function of every command, with its words."""
    for entry in group.registered_commands:
        yield " ".join((*path, entry.name)), entry.callback
    for entry in group.registered_groups:
        yield from walk(entry.typer_instance, (*path, entry.name))


@dataclass(frozen=True)
class Word:
    """An argument or option of a command."""

    name: str
    kind: frozenset
    required: bool

    @property
    def option(self):
        return self.name.startswith("--")


def words_in(function):
    """The arguments and options of a command."""
    hints = typing.get_type_hints(function, include_extras=True)
    found = []
    for name, parameter in inspect.signature(function).parameters.items():
        info = next((i for i in getattr(hints[name], "__metadata__", ()) if isinstance(i, ParameterInfo)), None)
        if info is not None:
            inner = typing.get_args(hints[name])[0]
            kinds = frozenset((inner, *typing.get_args(inner)))
            # Typer takes the first name of an annotated option for its default until the command is made.
            decls = [d for d in (info.default, *(info.param_decls or ())) if isinstance(d, str) and d.startswith("--")]
            own = decls[0] if decls else f"--{name.replace('_', '-')}"
            named = own if isinstance(info, OptionInfo) else name
            found.append(Word(named, kinds, parameter.default is inspect.Parameter.empty))
    return found


COMMANDS = {name: words_in(function) for name, function in walk(app)}
CASES = [
    (name, word.name)
    for name, words in COMMANDS.items()
    if name not in APART
    for word in words
    if word.option and word.kind & {int, float}
]


@pytest.fixture
def edp(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["edp", *words])
        code = run_app(app)
        text = capsys.readouterr()
        return code, " ".join(text.err.split()), sorted(p.name for p in tmp_path.iterdir())

    return run


def words_of(name):
    """The command with all that it asks for; nothing that it would read is there."""
    words = name.split()
    for word in COMMANDS[name]:
        if word.required and word.option:
            words += [word.name, "16" if int in word.kind else "made"]
        elif word.required:
            words.append("missing")
    return words


def test_the_commands_are_all_there():
    assert {"train", "evaluate", "search run", "finetune", "adapt", "screen", "quantise", "parity"} <= set(COMMANDS)
    assert len(CASES) > 30
    assert set(ALWAYS_WRONG) <= set(CASES)


@pytest.mark.parametrize(("name", "option"), CASES)
def test_extreme_numbers_end_in_one_message(name, option, edp):
    for value in EXTREMES:
        code, err, _ = edp(*words_of(name), option, value)
        assert code in (1, 2), f"{value}: {err}"
        assert "error: " in err, f"{value}: {err}"
        assert "Traceback" not in err
        assert len(err) < 8000


@pytest.mark.parametrize(("name", "option"), list(ALWAYS_WRONG))
def test_numbers_that_cannot_be_are_refused_by_name(name, option, edp):
    """Before anything is read: what would be read is not there."""
    for value in ALWAYS_WRONG[name, option]:
        code, err, left = edp(*words_of(name), option, value)
        assert code in (1, 2)
        said = err.partition("error: ")[2]
        key = option.removeprefix("--").replace("-", "_")
        assert key in said or option in said, f"{value}: {said}"
        assert left == []


def test_every_option_of_a_path_is_known():
    held = {word.name for words in COMMANDS.values() for word in words if word.option and Path in word.kind}
    assert held <= PATH_OPTIONS, held - PATH_OPTIONS


@pytest.mark.parametrize("option", sorted(PATH_OPTIONS))
@pytest.mark.parametrize("form", ["apart", "joined"])
def test_empty_paths_are_refused(option, form, edp):
    code, err, left = edp("train", "missing", *([option, ""] if form == "apart" else [f"{option}="]))
    assert code == 1
    assert f"{option} is empty; give a path" in err
    assert left == []


def test_empty_arguments_are_refused_and_empty_texts_are_not(edp):
    code, err, _ = edp("inspect", "")
    assert code == 1
    assert "an argument is empty" in err
    code, err, _ = edp("screen", "missing", "--out", "x", "--targets", "")
    assert "missing" in err
    assert code == 1
