"""Shared options of commands: declarations, validation, and former options with the settings that replace them."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.errors import ConfigError
from edp.settings.bounds import MAX_SHOWN, Bound, shown
from edp.settings.earlier_keys import KEYS

if TYPE_CHECKING:
    from edp.jobs import Workers
    from edp.logs.source import DataSource

MAX_WORKERS = 256
MOST_LOOPS = 10_000
MOST_TICKS = 1_000_000
"""Of a reference recording: three hours at 100 Hz."""
MAX_SECONDS, MAX_MINUTES, MAX_HOURS = 1e6, 1e6, 1e6
"""Lengths of runs and logs, processor time, and lengths of data sets: more than anybody has."""
LogsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOGS...",
        help="Logs and folders of logs; or one data-set file (.toml), or one store.",
    ),
]
DataOption = Annotated[
    list[Path],
    typer.Option(
        "--data",
        help="Other recordings: logs and folders of logs, a data-set file, or a store; may be repeated. Default: those "
        "of the run.",
    ),
]
MapOption = Annotated[Path | None, typer.Option("--map", help="Signal map (TOML) from your columns to channels.")]
RepairOption = Annotated[
    list[str], typer.Option("--repair", help="Repair logs: nan=hold, gaps=hold|cut, duplicates=last, falling=sort|cut.")
]
SettingsOption = Annotated[
    Path | None,
    typer.Option("--config", help="Settings (TOML): the table of this command, and tables of its trainings."),
]
WorkersOption = Annotated[
    int, typer.Option(min=0, max=MAX_WORKERS, help="Processes side by side; 0: one for each core.")
]
ClusterOption = Annotated[
    str,
    typer.Option(help="Address of a Ray cluster that does the work, or auto; all paths must lead to the same there."),
]
OpenOption = Annotated[
    bool,
    typer.Option(
        "--open-cluster", help="Accept a cluster without a token, on which anyone who can reach it can run code."
    ),
]

OWNERS: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("*", "open_cluster"): ("cluster",),
    ("compress distil", "signal_map"): ("data", "unlabelled"),
    ("compress distil", "repair"): ("data", "unlabelled"),
    ("compress search", "signal_map"): ("data",),
    ("compress search", "repair"): ("data",),
    ("evaluate", "signal_map"): ("data",),
    ("evaluate", "repair"): ("data",),
    ("export", "signal_map"): ("w8a16",),
    ("export", "repair"): ("w8a16",),
    ("verify", "signal_map"): ("data",),
    ("verify", "repair"): ("data",),
    ("data screen", "preset"): ("trials",),
    ("data screen", "own"): ("trials",),
    ("train finetune", "delta_kb"): ("fleet",),
}
"""Parameters by command ("*": every command), each with the parameters one of which it needs."""
EXCLUDED: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("train finetune", "fleet"): ("baselines",),
    ("adapt replay", "frozen"): ("carry",),
    ("data check", "page"): ("covered",),
    ("data check", "split"): ("covered",),
    ("data check", "inputs"): ("covered",),
    ("data check", "as_json"): ("details",),
    ("runs", "as_json"): ("max_runs",),
}
"""Parameters by command ("*": every command), each with parameters that have no effect beside it."""
TRIAL_TABLES = ("trials", "task", "split", "model", "training", "evaluation")
"""Settings of the trials of edp data screen: their own table and those of an experiment."""
DEPENDENT: Mapping[tuple[str, str], str] = {
    ("data animate", "horizon"): "a run before the log",
    ("evaluate", "baselines"): "the run of a network (evaluation.baselines are those of a twin)",
    ("evaluate", "time_budget"): "the run of a network, baselines, and one process",
    ("evaluate", "max_hours"): "the run of a network",
    ("evaluate", "channel_importance"): "the run of a network",
    ("evaluate", "workers"): "the run of a network",
    ("evaluate", "cluster"): "the run of a network",
    ("evaluate", "predictor"): "the run of a twin, with which it is compared",
    ("monitor fit", "time_budget"): "residuals of networks: virtual_sensors or look_ahead",
    ("verify", "interpreters"): "a form of ONNX Runtime: onnx_step or onnx_window",
    ("train pretrain", "changes.pretrain"): "an episodic method",
    ("report", "limit"): "the run of a network, which looks a fixed time ahead",
    ("report", "budget"): "the run of a network (edp compress estimate takes twins)",
    ("search run", "budget"): "phase 6 (search.compression.enabled)",
    **{("data screen", f"changes.{table}"): "--trials" for table in TRIAL_TABLES},
    ("simulate", "changes.limit"): "--limit",
    ("train run", "time_budget"): "the preset auto",
    ("train run", "workers"): "the preset auto",
    ("train run", "cluster"): "the preset auto",
    ("twin", "time_budget"): "a choice among formulations (without twin.kind, --start and ground)",
    **{
        ("twin", option): "several trainings (a choice among formulations, twin.members above 1, or --start)"
        for option in ("workers", "cluster")
    },
}
"""Parameters by command whose effect depends on settings or files that the command reads, each with what it needs.

``changes.TABLE`` are the values of ``--set`` for one table of the settings.
"""
_TABLES = {
    "train finetune": "finetune",
    "adapt run": "adapt",
    "compress distil": "distil",
    "compress search": "compress",
    "train pretrain": "pretrain",
    "data screen": "screen",
}
"""Table of settings by command."""
_SAME = {
    "train finetune": "head_epochs epochs head_rate backbone_rate depth_decay rounds rate batch smoothness "
    "weight_decay patience rank source_weight soft reversal inner_rate inner_steps center",
    "adapt run": "rank noise prior limit margin",
    "compress distil": "levels",
    "compress search": "units",
    "train pretrain": "inner_rate inner_steps shots",
    "data screen": "trusted",
}
_KEYS = {**KEYS["FinetuneSpec"], **KEYS["MetaSpec"], **KEYS["ScreeningSpec"]}
FORMER = {
    (command, name): f"{_TABLES[command]}.{_KEYS.get(name, name)}=VALUE"
    for command, names in _SAME.items()
    for name in names.split()
} | {
    ("train finetune", "no_center"): "finetune.center=false",
    ("train finetune", "any_sign"): "finetune.check_signs=false",
    ("adapt run", "rest"): "adapt.dead_zone=VALUE",
    ("adapt run", "forgetting"): "adapt.forgetting_s=VALUE",
    ("adapt run", "judged"): "adapt.evaluation_s=VALUE",
    ("compress distil", "pruned"): "distil.pruned=true",
    ("compress distil", "truth"): "distil.objective.target_weight=VALUE",
    ("compress distil", "hint"): "distil.objective.hint_weight=VALUE",
    ("compress search", "format"): "compress.formats=[VALUE]",
    ("compress search", "thesis"): "compress.thesis=true",
    ("compress search", "units"): "compress.units=[VALUE]",
    ("train pretrain", "head_only"): "pretrain.head_only=true",
    ("data screen", "trusted"): "screen.measured=[VALUE]",
    ("data screen", "random"): "trials.random_sets=VALUE",
    ("search run", "mode"): "search.mode=VALUE",
    ("simulate", "masses"): "masses=[LOW, HIGH]",
    ("simulate", "scatter"): "scatter=VALUE",
    ("simulate", "layout"): "files.layout=VALUE",
    ("simulate", "truth"): "files.truth=VALUE",
    ("simulate", "moments"): "limit.moments=VALUE",
    ("simulate", "branches"): "limit.branches=VALUE",
    ("simulate", "horizons"): "limit.horizons=[VALUE]",
}
"""By command and option up to version 0.1, what stands behind ``--set`` for it now."""


_UNITS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_TIME = re.compile(r"\s*([-+.\deE]*[\d.])\s*(ms|s|min|h)\s*")


def parse_seconds(text: str) -> float:
    """Return a length of time with a unit, such as ``90s``, ``3min`` or ``2h``, in seconds.

    Raises:
        BadParameter: the text is not a number with one of these units.
    """
    match = _TIME.fullmatch(str(text))
    try:
        return float(match[1]) * _UNITS[match[2]] if match else float(text if isinstance(text, float) else "")
    except ValueError:
        raise typer.BadParameter(
            f"got '{text[:MAX_SHOWN]}', expected a number with a unit (ms, s, min or h), such as 90s, 3min or 2h"
        ) from None


def parse_minutes(text: str) -> float:
    """Return a length of time with a unit in minutes; see `parse_seconds`."""
    return parse_seconds(text) / 60.0


def complete(load: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return the shell completion of an option with a closed list of values.

    Args:
        load: returns the values; called only while the shell completes.
    """

    def matching(incomplete: str) -> list[str]:
        return [name for name in load() if name.startswith(incomplete)]

    return matching


def complete_from(module: str, name: str) -> Callable[[str], list[str]]:
    """Return the shell completion of an option whose values are the entries of a registry or tuple.

    Args:
        module: module of the registry, imported only while the shell completes.
        name: its name in the module.
    """
    return complete(lambda: getattr(importlib.import_module(module), name))


def within(bound: Bound) -> Callable[[typer.CallbackParam, Any], Any]:
    """Return a Typer callback that raises ConfigError for a value outside a bound, also within lists.

    Raises:
        ConfigError: a value is outside the bound; the message names option, value and bound.
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


def source_of(data: Path | Sequence[Path], signal_map: Path | None, repair: list[str]) -> DataSource:
    """Return a data source from command-line options."""
    from edp.config.experiment import build
    from edp.logs.repair import Repair
    from edp.logs.source import DataSource

    table: dict[str, str] = {}
    for text in repair:
        # Only the first sign parts key and value.
        key, sign, value = text.partition("=")
        if not sign:
            raise ConfigError(f"--repair '{text}': write what=how, for example nan=hold")
        table[key] = value
    return DataSource.from_path(data, signal_map, build(Repair, table, "--repair") if table else None)


def source_if_given(data: Sequence[Path], signal_map: Path | None, repair: list[str]) -> DataSource | None:
    """Return a data source from command-line options; None if no path was given."""
    return source_of(data, signal_map, repair) if data else None


def workers_of(count: int, cluster: str, open_cluster: bool, usual: int = 1) -> Workers:
    """Return the workers for the options ``--workers``, ``--cluster`` and ``--open-cluster``.

    Args:
        count: value of ``--workers``.
        cluster: value of ``--cluster``.
        open_cluster: value of ``--open-cluster``.
        usual: number of workers where the option is left out; not refused together with a cluster.
    """
    from edp.jobs import Workers

    chosen = 1 if cluster and count == usual else count
    return Workers(count=chosen, cluster=cluster, open_cluster=open_cluster)


def setting_of(command: str, option: str) -> str | None:
    """Return the ``--set`` form of an option that is a setting now; None for any other word."""
    setting = FORMER.get((command, option.lstrip("-").replace("-", "_")))
    return None if setting is None else f"--set '{setting}'"


def check_belonging(context: typer.Context) -> None:
    """Raise ConfigError for options that have no effect with the other options given.

    Args:
        context: the parsed command line of one command.

    Raises:
        ConfigError: names the option and the one that it depends on.
    """
    command = words_of(context)
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
        needed = DEPENDENT[words_of(context), name]
        raise ConfigError(f"{word}: it has no effect without {needed}; leave {word} out")


def words_of(context: typer.Context) -> str:
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
