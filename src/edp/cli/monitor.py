"""``edp monitor``: fit a monitor to healthy logs of a machine, and watch logs with it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, duration, emit, out, table
from edp.cli.options import (
    ClusterOption,
    LogsArgument,
    MapOption,
    OpenOption,
    RepairOption,
    WorkersOption,
    check_effects,
    parse_minutes,
    source_of,
    workers_of,
)
from edp.cli.progress import show_progress
from edp.errors import ConfigError, count_of
from edp.storage.paths import full_path
from edp.wording import figure

if TYPE_CHECKING:
    from edp.workflows.monitor import FittedMonitor

# Scripts can tell alarms by the exit code.
ALARMS = 5
MAX_SHOWN = 50
"""Changes that are printed; the files have all alarms."""
ALARM_HEADS = ["", "raised, s", "since, s", "severity", "alarms", ""]

app = typer.Typer(
    name="monitor",
    help="Detect faults of a machine and its sensors, with a specified false-alarm rate.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.command("fit")
def fit(
    context: typer.Context,
    arguments: Annotated[
        list[Path],
        typer.Argument(
            metavar="[RUN]... LOGS...",
            help="Run folders of this machine, if any, and healthy logs: logs and folders of logs; or one data-set "
            "file (.toml), or one store.",
        ),
    ],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the monitor.")],
    hours: Annotated[
        float | None, typer.Option("--hours-per-false-alarm", help="Operating hours to one false alarm; default: 8.")
    ] = None,
    time_budget: Annotated[
        float | None,
        typer.Option(
            parser=parse_minutes, metavar="TIME", help="Processor time of the networks, such as 30min; default: 5min."
        ),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            help="Machine (name or .toml) whose faults are simulated to name causes, or none; default: the logs'."
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Settings (TOML).")] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example chain.block_s=2.")] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Fit a monitor to healthy logs: expected readings of each channel and alarm limits.

    Healthy logs are divided by sessions: some train, the others say how widely a healthy machine scatters and set the
    limit. Hours that are too few for the promise are refused, with the rate that they support. Faults are simulated on
    the machine that the logs name or --machine gives, some minutes; without one, alarms have no causes.

    With balances of flow (logs with command, velocity and both pressures of a cylinder) a monitor belongs to the one
    machine of its logs; for all machines of a series, add `--set chain.tolerance=0.01`.

    Example: `edp monitor fit runs/m22 logs/healthy --out monitors/m22`
    """
    from edp.config.monitor import load_monitor_experiment, trains_networks
    from edp.workflows.monitor import fit_monitor
    from edp.workflows.monitor.fit_monitor import holds_model

    options: dict[str, object] = {} if hours is None else {"hours_per_false_alarm": hours}
    options |= {} if time_budget is None else {"time_budget_min": time_budget}
    options |= {} if machine is None else {"dictionary": {"machine": machine}}
    experiment = load_monitor_experiment(config, changes, options)
    check_effects(context, {"time_budget": trains_networks(experiment)})
    runs = [path for path in arguments if holds_model(path)]
    logs = [path for path in arguments if path not in runs]
    if not logs:
        raise ConfigError("edp monitor fit: got run folders alone, expected healthy logs; name them after the runs")
    source = source_of(logs, signal_map, repair)
    divided = workers_of(workers, cluster, open_cluster)
    began = time.monotonic()
    with show_progress("monitor", as_json) as progress:
        fitted = fit_monitor(runs, source, experiment, folder, progress, divided)
    monitor = fitted.monitor
    wall_s = time.monotonic() - began
    facts = {
        "monitor": str(folder),
        "seconds": fitted.seconds,
        "wall_s": wall_s,
        "workers": divided.processes,
        "residuals": list(monitor.residual_names),
        "doubtful": list(fitted.doubtful),
        "one_machine": fitted.one_machine,
        "promise": monitor.limit.sentence(),
        "found_sizes": list(monitor.provenance.get("found_sizes", [])),
        "found_effort": monitor.provenance.get("found_effort"),
    }

    def show() -> None:
        show_fitted(fitted)
        spent = f"{duration(fitted.seconds)} of processor time"
        if cluster:
            spent = f"{duration(wall_s)} on the cluster at {cluster}"
        elif not divided.are_alone:
            spent = f"{duration(wall_s)} by {divided.processes} processes"
        fitted_text = "was fitted before, nothing to do" if fitted.is_read else f"fitted in {spent}"
        out.print(f"{fitted_text}; monitor in {folder}")
        out.print(f"next: edp monitor run {folder} LOGS")

    emit(as_json, facts, show)


def show_fitted(fitted: FittedMonitor) -> None:
    """Print the monitored residuals, the false alarm rate, and the machines to which a monitor applies."""
    monitor = fitted.monitor
    for name in fitted.doubtful:
        out.print(f"'{name}' was left out: it lies far from all other healthy sessions; look into it")
    out.print(f"{len(monitor.residual_names)} residuals of {count_of(len(monitor.channels), 'channel')} are watched")
    out.print(monitor.limit.sentence())
    for line in fitted.finds:
        out.print(line)
    if fitted.one_machine:
        out.print(
            "its balances of flow know this machine's valves to 1 %: it belongs to this one machine and raises "
            "alarms on others of its series; for those, fit with --set chain.tolerance=0.01, which finds less"
        )


@app.command("run")
def run(
    folder: Annotated[Path, typer.Argument(metavar="MONITOR", help="Folder that edp monitor fit wrote.")],
    logs: LogsArgument,
    target: Annotated[
        Path | None, typer.Option("--out", help="Folder for the alarms (JSON lines, CSV) and what the page shows.")
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    mdf: Annotated[
        Path | None, typer.Option("--mdf", help="Folder for the logs as MDF 4, with the alarms as events.")
    ] = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Watch logs: every alarm with when, since when, and what deviates; exit code 5 where there was one.

    Channels that a log lacks are silent with all that reads them, which is said. A log of another machine is refused,
    and one that looks like a sister of the monitor's machine is named.

    Example: `edp monitor run monitors/m22 logs/today --out watched/today`
    """
    from edp.workflows.monitor import run_monitor

    divided = workers_of(workers, cluster, open_cluster)
    with show_progress("monitor", as_json, "recordings watched") as progress:
        watched = run_monitor(folder, source_of(logs, signal_map, repair), target, progress, divided)

    if mdf is not None:
        from edp.workflows.monitor.event_files import write_event_files

        write_event_files(watched.alarms, source_of(logs, signal_map, repair).read(), mdf)

    def show() -> None:
        for name, channels in watched.silent.items():
            out.print(f"'{name}' lacks {', '.join(channels)}: what judges or reads these channels is silent")
        for name, reasons in watched.unlearned.items():
            for reason in reasons:
                out.print(f"'{name}': {reason}")
        for name, reason in watched.unlike.items():
            out.print(f"'{name}': {reason}")
        # A fault that stays alarms again and again: one row tells it.
        rows = [
            [
                first.recording,
                figure(first.raised_s),
                figure(first.since_s),
                first.severity,
                1 + len(again),
                first.sentence,
            ]
            for first, *again in watched.changes
        ]
        if rows:
            table("changes, and how often each raised an alarm", ALARM_HEADS, rows[:MAX_SHOWN])
        if mdf is not None:
            out.print(f"logs with their alarms as events in {mdf}")
        if len(rows) > MAX_SHOWN:
            out.print(f"and {len(rows) - MAX_SHOWN:,} more")
        count = f"{len(watched.alarms):,} alarms" if watched.alarms else "no alarm"
        out.print(f"{count} in {figure(watched.hours, 3)} h; {watched.monitor.limit.sentence()}")
        for line in watched.silence:
            out.print(line)
        if target is not None:
            out.print(f"alarms in {target}; next: edp monitor report {target}")

    emit(as_json, {"run": target and str(target), **watched.to_json()}, show)
    if watched.alarms:
        raise typer.Exit(ALARMS)


@app.command("report")
def report(
    run: Annotated[Path, typer.Argument(metavar="MONITOR_RUN", help="Folder that edp monitor run --out wrote.")],
    page: Annotated[Path | None, typer.Option("--out", help="The page; default: report.html in the folder.")] = None,
    title: Annotated[str | None, typer.Option(help="Title of the page.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write an offline page: alarms with evidence and causes, time line, indistinguishable faults.

    Example: `edp monitor report watched/today`
    """
    from edp.report.monitor.facts import headline
    from edp.workflows.monitor import report_monitor

    written, facts = report_monitor(run, page, title)
    line = headline(facts)

    def show() -> None:
        out.print(line)
        out.print(f"report: {full_path(written)}")

    emit(as_json, {"report": str(written), "headline": line, "alarms": len(facts.alarms)}, show)
