"""``edp adapt`` and ``edp adapt replay``: a correction that is learned on board, and its effect on recorded logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table
from edp.cli.groups import RUN, RunByDefault
from edp.cli.options import LogsArgument, MapOption, RepairOption, SettingsOption, source_of
from edp.cli.progress import show_progress
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.wording import figure, percent

if TYPE_CHECKING:
    from edp.evaluation.adaptation_file import AdaptationFile, ReplayErrors


app = typer.Typer(
    cls=RunByDefault,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Add an online correction to a trained network. `edp adapt RUN` is short for `edp adapt run RUN`.",
)


@app.command(RUN)
def adapt(
    run: Annotated[Path, typer.Argument(help="Run folder of edp train, finetune, distil, compress or quantise.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the new run.")],
    config: SettingsOption = None,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting of the correction, for example adapt.forgetting_s=30.")
    ] = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Add a small, bounded correction to a run that is learned on board; export and replay include it.

    Its limits and directions are fitted to the run's own recordings; the network stays as it is.

    Example: `edp adapt runs/first --out runs/first_adapted`

    Example: `edp adapt runs/first --out runs/first_adapted --set adapt.rank=12`
    """
    from edp.config.commands import command_settings
    from edp.evaluation.guard import adaptation_verdict
    from edp.workflows.adaptation import AdaptationSpec
    from edp.workflows.adaptation import adapt as make

    spec, _ = command_settings("adapt", AdaptationSpec, config, changes)
    adapted = make(run, folder, spec)
    correction, content = adapted.adaptation, adapted.content
    verdict = adaptation_verdict(content)

    def show() -> None:
        show_verdict(verdict)
        out.print(f"{correction.features} features, {correction.macs:,} multiply-accumulates a tick; {folder}")
        out.print("its test recordings, each from nothing:")
        replay_tables(content)
        out.print(f"next: edp adapt replay {folder} LOGS, edp export {folder} --format c --out firmware/predictor")

    emit(
        as_json,
        {"folder": str(folder), "features": correction.features, "macs": correction.macs, "replay": content.to_table()}
        | verdict_facts(verdict),
        show,
    )
    end_with(verdict)


@app.command("replay")
def replay(
    run: Annotated[Path, typer.Argument(help="Run folder of edp adapt, or its bundle.")],
    logs: LogsArgument,
    carry: Annotated[
        bool, typer.Option(help="Carry the learned coefficients from one log to the next, as on one machine.")
    ] = False,
    frozen: Annotated[bool, typer.Option("--frozen", help="Apply the correction without learning.")] = False,
    twin: Annotated[
        Path | None,
        typer.Option("--twin", help="Grey box of the machine as it was: its numbers follow, and it is mixed in."),
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Run logs through a network and its adaptation, tick by tick: the error with and without, over time in motion.

    Example: `edp adapt replay runs/first_adapted logs/monday --carry`

    Example: `edp adapt replay runs/first_adapted logs/monday --twin runs/grey`
    """
    from edp.evaluation.guard import adaptation_verdict
    from edp.workflows.adaptation import replay_run

    with show_progress("replay", as_json, "done") as progress:
        content = replay_run(run, source_of(logs, signal_map, repair), carry, not frozen, progress, twin)

    verdict = adaptation_verdict(content)

    def show() -> None:
        show_verdict(verdict)
        replay_tables(content)

    emit(as_json, content.to_table() | verdict_facts(verdict), show)
    end_with(verdict)


def replay_tables(content: AdaptationFile) -> None:
    """Print one table per horizon: MAE with and without adaptation over time in motion, and by target."""
    units = {target.unit for target in content.targets}
    unit = units.pop() if len(units) == 1 else "mixed units"
    heads = ["seconds of motion", "without", "adapted", "change", *(target.name for target in content.targets)]
    for horizon in sorted({row.horizon for row in content.mae}):
        rows = [_line(row) for row in content.mae if row.horizon == horizon]
        table(f"MAE k = {horizon} ahead, {unit}; by target: without / adapted", heads, rows)
    out.print(f"taken back in {percent(content.fallback)} of the ticks; {content.taught:,} ticks taught")


def _line(row: ReplayErrors) -> list[str]:
    base, adapted = (sum(errors) / len(errors) for errors in (row.base, row.adapted))
    when = f"over {figure(row.from_s)}" if row.to_s is None else f"{figure(row.from_s)} to {figure(row.to_s)}"
    # Nothing to relate to where the error is zero.
    change = percent(adapted / base - 1, signed=True) if base else "-"
    pairs = [f"{figure(b, 3)} / {figure(a, 3)}" for b, a in zip(row.base, row.adapted, strict=True)]
    return [when, f"{figure(base)}", f"{figure(adapted)}", change, *pairs]
