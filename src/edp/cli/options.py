"""Validation of command-line options: bounds of numeric options and dependencies between options."""

from __future__ import annotations

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
}
"""Parameters by command ("*": every command), each with parameters that have no effect beside it."""


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
    command = " ".join(context.command_path.split()[1:])
    words = {parameter.name: _word(parameter) for parameter in context.command.params}
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


def _rules(
    table: Mapping[tuple[str, str], tuple[str, ...]], command: str, words: Mapping[Any, str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the rules of one command; rules of every command only where all parameters exist."""
    for (where, name), others in table.items():
        if where == command or (where == "*" and name in words and all(other in words for other in others)):
            yield name, others


def _word(parameter: Any) -> str:
    """Return the name of a parameter as a user types it."""
    return str(parameter.opts[0]) if parameter.param_type_name == "option" else str(parameter.name).upper()


def _is_given(context: typer.Context, name: Any) -> bool:
    """Return whether the command line sets a parameter to a value other than its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE" and bool(context.params.get(name))
