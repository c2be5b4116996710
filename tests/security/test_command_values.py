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
from edp.cli.options import FORMER

EXTREMES = ("-1", "0", "1e9", "1000000000000", "9" * 6000, "nan", "1e400", "")
APART = {"simulate", "demo"}
"""Their numbers are tested with the simulator's."""
ALWAYS_WRONG = {
    ("compress distil", "--units"): ("-1", "0", "1000000000000"),
    ("compress quantise", "--calibration-samples"): ("-1", "0", "1000000000000"),
    ("search run", "--workers"): ("-1", "1000000000000"),
    ("search run", "--threads"): ("-1", "0", "1000000000000"),
    ("search run", "--max-seconds"): ("-1", "0", "nan", "inf"),
    ("search run", "--max-memory"): ("-1", "0", "nan", "inf"),
}
HUGE = "1000000000000"
SETTINGS_ALWAYS_WRONG = {
    ("compress distil", "distil.units"): ("-1", "0", HUGE, "wide"),
    ("compress distil", "distil.levels"): ("-1", "0", "1000"),
    ("compress distil", "distil.objective.target_weight"): ("-1", "nan", "inf"),
    ("compress distil", "distil.objective.hint_weight"): ("-1", "nan", "inf"),
    ("compress distil", "distil.objective.distillation_loss"): ('{kind="quantile"}', '{kind="huberr"}'),
    ("train pretrain", "pretrain.inner_learning_rate"): ("-1", "0", "nan", "inf"),
    ("train pretrain", "pretrain.inner_steps"): ("-1", "0", HUGE),
    ("train pretrain", "pretrain.shots"): ("-1", "0", HUGE),
    ("train finetune", "finetune.epochs"): ("-1", "0", HUGE, "9" * 6000),
    ("train finetune", "finetune.head_learning_rate"): ("-1", "nan", "inf"),
    ("train finetune", "finetune.batch"): ("-1", "0", HUGE),
    ("train finetune", "finetune.smoothness"): ("-1", "nan", "inf"),
    ("train finetune", "finetune.weight_decay"): ("-1", "nan", "inf"),
    ("train finetune", "finetune.patience"): ("-1", HUGE),
    ("train finetune", "finetune.rank"): ("-1", "0", HUGE),
    ("train finetune", "finetune.distillation_fraction"): ("-1", "nan", "2"),
    ("train finetune", "finetune.inner_learning_rate"): ("-1", "nan", "inf"),
    ("train finetune", "finetune.center"): ("1", "no"),
    ("adapt run", "adapt.rank"): ("-1", HUGE),
    ("adapt run", "adapt.noise"): ("-1", "nan", "inf"),
    ("adapt run", "adapt.dead_zone"): ("-1", "nan", "inf"),
    ("compress search", "compress.units"): ("[-1]", "[0]", f"[{HUGE}]", "3"),
    ("compress search", "compress.formats"): ('["w8a6"]', "w8a16"),
    ("compress search", "compress.recipes"): ("[]", '["stirred"]'),
    ("compress search", "compress.budget"): ("small.toml", "{cycles=-1}"),
    ("data screen", "screen.max_lag"): ("-1", "0", HUGE, "nan"),
    ("simulate", "limit.moments"): ("-1", "0", HUGE, "nan"),
    ("simulate", "limit.horizons"): ("[0]", "[]", "[5,2]", "1"),
    ("simulate", "masses"): ("12", "[12]", "[nan,12]"),
}
"""By command and key of its table; the table is checked before anything is read or written."""


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

SLIPS = ("-1", "0", "1e-320", "1e308", "nan", "inf", "1000000000000000000")
SENSIBLE = {
    ("*", "--workers"): {"0"},  # one for each core
    ("demo", "--seed"): {"0"},
    ("simulate", "--seed"): {"0", "1000000000000000000"},
    ("simulate", "--family"): {"0"},  # one machine
    ("data screen", "--horizon"): {"0"},
    ("data animate", "--from"): {"0", "1e-320"},
    ("rollout", "--from"): {"0", "1e-320"},
    ("data add-forecasts", "--observer-gain"): {"0", "1e-320"},
    ("live", "--port"): {"0"},
    ("live", "--udp"): {"0"},
    ("live", "--seed"): {"0"},
    ("live", "--speed"): {"inf"},  # as fast as it goes
}
"""Values of `SLIPS` that an option takes."""
ALL_NUMBERS = [
    (name, word.name) for name, words in COMMANDS.items() for word in words if word.option and word.kind & {int, float}
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
    expected = {"train run", "evaluate", "search run", "train finetune", "adapt run", "data screen", "verify"}
    assert expected <= set(COMMANDS)
    assert len(CASES) > 10
    assert {name for name, _ in SETTINGS_ALWAYS_WRONG} <= set(COMMANDS)
    assert set(ALWAYS_WRONG) <= set(CASES)


WITHOUT_INPUTS = {"loop run", "loop tune"}
"""Commands that begin to work with a value that their option takes."""


@pytest.mark.parametrize(("name", "option"), CASES)
def test_extreme_numbers_end_in_one_message(name, option, edp):
    taken = SENSIBLE.get(("*", option), set()) if name in WITHOUT_INPUTS else set()
    for value in (value for value in EXTREMES if value not in taken):
        code, err, _ = edp(*words_of(name), option, value)
        assert code in (1, 2), f"{value}: {err}"
        assert "error: " in err, f"{value}: {err}"
        assert "Traceback" not in err
        assert len(err) < 8000


@pytest.mark.parametrize(("name", "option"), ALL_NUMBERS)
def test_every_number_has_bounds_that_are_checked_before_anything_is_read(name, option, edp):
    """Every numeric option of every command, also of later ones: refused by name while nothing is there to read."""
    source = ["--sim", "M22"] if name == "live" and option != "--udp" else []
    allowed = SENSIBLE.get((name, option), set()) | SENSIBLE.get(("*", option), set())
    for value in SLIPS:
        if value in allowed:
            continue
        code, err, left = edp(*words_of(name), *source, option, value)
        said = err.partition("error: ")[2]
        assert code in (1, 2), f"{value} was taken: {err}"
        assert option in said or option.removeprefix("--").replace("-", "_") in said, f"{value}: {said}"
        assert "Traceback" not in err
        assert left == [], f"{value}: {left}"


def test_values_that_an_option_takes_belong_to_options():
    assert {case for case in SENSIBLE if case[0] != "*"} <= set(ALL_NUMBERS)


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


@pytest.mark.parametrize(("name", "key"), list(SETTINGS_ALWAYS_WRONG))
def test_settings_that_cannot_be_are_refused_by_name(name, key, edp):
    for value in SETTINGS_ALWAYS_WRONG[name, key]:
        width = ["--set", "distil.units=4"] if name == "compress distil" else []
        code, err, left = edp(*words_of(name), *width, "--set", f"{key}={value}")
        assert code == 1, f"{value}: {err}"
        said = err.partition("error: ")[2]
        assert key.rpartition(".")[2] in said, f"{value}: {said}"
        assert left == []


def test_a_key_of_a_table_is_named_with_its_table(edp):
    for command, key in (("train finetune", "rounds"), ("adapt run", "rank"), ("train pretrain", "shots")):
        code, err, _ = edp(*words_of(command), "--set", f"{key}=3")
        assert (code, f"did you mean '{command.removesuffix(' run').split()[-1]}.{key}'?" in err) == (1, True), err


@pytest.mark.parametrize(("command", "option"), list(FORMER))
def test_options_that_became_settings_say_so(command, option, edp):
    name = "search run" if command == "run" else command
    flag = f"--{option.replace('_', '-')}"
    assert flag not in [word.name for word in COMMANDS[name]]
    code, err, left = edp(*words_of(name), flag, "3")
    assert code == 2
    assert f"error: {flag} is a setting now: give --set '{FORMER[command, option]}'" in err
    assert left == []


@pytest.mark.parametrize(("command", "option"), [case for case in FORMER if FORMER[case].endswith("VALUE")])
def test_settings_of_former_options_are_there(command, option, edp):
    """A key that no table has would be unknown; this value is wrong, or nothing is there to be read."""
    name = "search run" if command == "run" else command
    code, err, _ = edp(*words_of(name), "--set", FORMER[command, option].replace("VALUE", "{nonsense=1}"))
    assert code == 1
    assert "unknown key" not in err


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
    code, err, _ = edp("data", "check", "")
    assert code == 1
    assert "an argument is empty" in err
    code, err, _ = edp("data", "screen", "missing", "--out", "x", "--targets", "")
    assert "missing" in err
    assert code == 1
