"""Validation of command-line options: bounds of numeric options and dependencies between options."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import typer

from edp.errors import ConfigError
from edp.settings.bounds import Bound, shown

MOST_WORKERS = 256
MOST_LOOPS = 10_000
MOST_TICKS = 1_000_000
"""Of a reference recording: three hours at 100 Hz."""
MOST_SECONDS, MOST_MINUTES, MOST_HOURS = 1e6, 1e6, 1e6
"""Lengths of runs and logs, processor time, and lengths of data sets: more than anybody has."""

OWNERS: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("*", "open_cluster"): ("cluster",),
    ("distil", "signal_map"): ("data", "further"),
    ("distil", "repair"): ("data", "further"),
    ("compress", "signal_map"): ("data",),
    ("compress", "repair"): ("data",),
    ("evaluate", "signal_map"): ("data",),
    ("evaluate", "repair"): ("data",),
    ("export", "signal_map"): ("w8a16",),
    ("export", "repair"): ("w8a16",),
    ("parity", "signal_map"): ("data",),
    ("parity", "repair"): ("data",),
    ("screen", "preset"): ("trials",),
    ("screen", "own"): ("trials",),
    ("finetune", "delta_kb"): ("fleet",),
}
"""Parameters by command ("*": every command), each with the parameters one of which it needs."""
EXCLUDED: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("finetune", "fleet"): ("baselines",),
    ("replay", "frozen"): ("carry",),
    ("inspect", "page"): ("covered",),
    ("inspect", "split"): ("covered",),
    ("inspect", "inputs"): ("covered",),
    ("inspect", "as_json"): ("details",),
    ("runs", "as_json"): ("most",),
}
"""Parameters by command ("*": every command), each with parameters that have no effect beside it."""
TRIAL_TABLES = ("trials", "task", "split", "model", "training", "judge")
"""Settings of the trials of edp screen: their own table and those of an experiment."""
DEPENDENT: Mapping[tuple[str, str], str] = {
    ("animate", "horizon"): "a run before the log",
    ("evaluate", "baselines"): "the run of a network (judge.floors are those of a twin)",
    ("evaluate", "minutes"): "the run of a network, baselines, and one process",
    ("evaluate", "at_most"): "the run of a network",
    ("evaluate", "channel_importance"): "the run of a network",
    ("evaluate", "workers"): "the run of a network",
    ("evaluate", "cluster"): "the run of a network",
    ("evaluate", "predictor"): "the run of a twin, with which it is compared",
    ("monitor fit", "minutes"): "residuals of networks: virtual_sensors or look_ahead",
    ("parity", "interpreters"): "a form of ONNX Runtime: onnx_step or onnx_window",
    ("pretrain", "changes.pretrain"): "an episodic method",
    ("report", "limit"): "the run of a network, which looks a fixed time ahead",
    ("report", "budget"): "the run of a network (edp footprint takes twins)",
    ("search run", "budget"): "phase 6 (search.compression.on)",
    **{("screen", f"changes.{table}"): "--trials" for table in TRIAL_TABLES},
    ("simulate", "changes.limit"): "--limit",
    ("train", "minutes"): "the preset auto",
    ("train", "workers"): "the preset auto",
    ("twin", "minutes"): "a choice among formulations (without twin.kind, --start and ground)",
    ("twin", "workers"): "several trainings (a choice among formulations, twin.members above 1, or --start)",
}
"""Parameters by command whose effect depends on settings or files that the command reads, each with what it needs.

``changes.TABLE`` are the values of ``--set`` for one table of the settings.
"""


def within(bound: Bound) -> Callable[[typer.CallbackParam, Any], Any]:
    """Return a Typer callback that raises ConfigError for a value outside a bound, also within lists.

    Raises:
        ConfigError: when called, with the option, the value and the bound.
    """

    def check(parameter: typer.CallbackParam, value: Any) -> Any:
        for entry in value if isinstance(value, list | tuple) else (value,):
            if entry is not None and not bound.holds(entry):
                name = parameter.opts[0]
                rule = bound.rule(name.lstrip("-").replace("-", "_"))
                raise ConfigError(
                    f"{name}: got {shown(entry)}, expected {rule}{bound.note(entry)}; give a number within these bounds"
                )
        return value

    return check


def check_belonging(context: typer.Context) -> None:
    """Raise ConfigError for options that have no effect with the other options given.

    Args:
        context: the parsed command line of one command.

    Raises:
        ConfigError: names the option and the one that it depends on.
    """
    command = _command(context)
    words = {parameter.name: _word(parameter, context) for parameter in context.command.params}
    stated = {name for name in words if _is_given(context, name)}
    for name, owners in _rules(OWNERS, command, words):
        if name in stated and not stated.intersection(owners):
            needed = " or ".join(words[owner] for owner in owners)
            raise ConfigError(
                f"{words[name]}: it has no effect without {needed}, to which it belongs; give {needed}, or leave "
                f"{words[name]} out"
            )
    for name, others in _rules(EXCLUDED, command, words):
        for other in others:
            if name in stated and other in stated:
                raise ConfigError(f"{words[other]}: it has no effect beside {words[name]}; leave one of them out")


def check_effects(context: typer.Context, effects: Mapping[str, bool]) -> None:
    """Raise ConfigError for options that have no effect with the settings and files that the command has read.

    Args:
        context: the parsed command line of one command.
        effects: whether each parameter of the command in `DEPENDENT` has an effect.

    Raises:
        ConfigError: names the option and what it depends on.
    """
    words = {str(parameter.name): _word(parameter, context) for parameter in context.command.params}
    for name, has_effect in effects.items():
        parameter, _, table = name.partition(".")
        if has_effect or not _is_given(context, parameter):
            continue
        word = words[parameter]
        if table:
            values = [text for text in context.params[parameter] if re.split(r"[.=]", text.strip())[0] == table]
            if not values:
                continue
            word = f"{word} {values[0]}"
        needed = DEPENDENT[_command(context), name]
        raise ConfigError(f"{word}: it has no effect without {needed}; leave {word} out")


def _command(context: typer.Context) -> str:
    """Return the words of the command without the name of the program."""
    return " ".join(context.command_path.split()[1:])


def _rules(
    table: Mapping[tuple[str, str], tuple[str, ...]], command: str, words: Mapping[Any, str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the rules of one command; rules of every command only where all parameters exist."""
    for (where, name), others in table.items():
        if where == command or (where == "*" and name in words and all(other in words for other in others)):
            yield name, others


def _word(parameter: Any, context: typer.Context) -> str:
    """Return the name of a parameter as a user types it; of a switch that was turned off, its second name."""
    if parameter.param_type_name != "option":
        return str(parameter.name).upper()
    off = context.params.get(parameter.name) is False and parameter.get_default(context) is not False
    return str(parameter.secondary_opts[0] if off and parameter.secondary_opts else parameter.opts[0])


def _is_given(context: typer.Context, name: Any) -> bool:
    """Return whether the command line sets a parameter to a value other than its default."""
    source = context.get_parameter_source(name)
    if source is None or source.name != "COMMANDLINE":
        return False
    default = next(one.get_default(context) for one in context.command.params if one.name == name)
    value = context.params.get(name)
    return value not in (None, "", [], ()) and value != default
