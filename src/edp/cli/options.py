"""Shared options of commands: declarations, validation, and former options with the settings that replace them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edp.errors import ConfigError
from edp.settings.bounds import Bound, shown

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
    ("train", "cluster"): "the preset auto",
    ("twin", "minutes"): "a choice among formulations (without twin.kind, --start and ground)",
    **{
        ("twin", option): "several trainings (a choice among formulations, twin.members above 1, or --start)"
        for option in ("workers", "cluster")
    },
}
"""Parameters by command whose effect depends on settings or files that the command reads, each with what it needs.

``changes.TABLE`` are the values of ``--set`` for one table of the settings.
"""
_SAME = {
    "finetune": "head_epochs epochs head_rate backbone_rate depth_decay rounds rate batch smoothness weight_decay "
    "patience rank source_weight soft reversal inner_rate inner_steps center",
    "adapt": "rank noise prior limit margin",
    "distil": "levels",
    "compress": "units",
    "pretrain": "inner_rate inner_steps shots",
    "screen": "trusted",
}
FORMER = {(command, name): f"{command}.{name}=VALUE" for command, names in _SAME.items() for name in names.split()} | {
    ("finetune", "no_center"): "finetune.center=false",
    ("finetune", "any_sign"): "finetune.check_signs=false",
    ("adapt", "rest"): "adapt.dead_zone=VALUE",
    ("adapt", "forgetting"): "adapt.forgetting_s=VALUE",
    ("adapt", "judged"): "adapt.judged_s=VALUE",
    ("distil", "pruned"): "distil.pruned=true",
    ("distil", "truth"): "distil.objective.truth=VALUE",
    ("distil", "hint"): "distil.objective.hint=VALUE",
    ("compress", "format"): "compress.formats=[VALUE]",
    ("compress", "thesis"): "compress.thesis=true",
    ("compress", "units"): "compress.units=[VALUE]",
    ("pretrain", "head_only"): "pretrain.head_only=true",
    ("screen", "trusted"): "screen.trusted=[VALUE]",
    ("screen", "random"): "trials.random=VALUE",
    ("run", "mode"): "search.mode=VALUE",
    ("simulate", "masses"): "masses=[LOW, HIGH]",
    ("simulate", "scatter"): "scatter=VALUE",
    ("simulate", "layout"): "files.layout=VALUE",
    ("simulate", "truth"): "files.truth=VALUE",
    ("simulate", "moments"): "limit.moments=VALUE",
    ("simulate", "branches"): "limit.branches=VALUE",
    ("simulate", "horizons"): "limit.horizons=[VALUE]",
}
"""By command and option up to version 0.1, what stands behind ``--set`` for it now."""


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
