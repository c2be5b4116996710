"""``edp train pretrain``: one network over many machines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, print_table
from edp.cli.options import (
    ClusterOption,
    LogsArgument,
    MapOption,
    OpenOption,
    RepairOption,
    SettingsOption,
    check_effects,
    source_of,
    workers_of,
)
from edp.cli.progress import show_progress

if TYPE_CHECKING:
    from edp.evaluation.foundation_file import FoundationFile


def pretrain(
    context: typer.Context,
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    method: Annotated[str, typer.Option(help="joint, codes, fomaml, maml or reptile.")] = "joint",
    start: Annotated[
        Path | None, typer.Option(help="Run folder or bundle of the initial weights; default: random.")
    ] = None,
    config: SettingsOption = None,
    preset: Annotated[str, typer.Option(help="quick, small, standard or thesis.")] = "standard",
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting, such as split.test_masses=[12,17] or pretrain.shots=8.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Train one network over many machines, and evaluate it on unseen machines.

    Whole machines validate and test. What comes out is a run: fine-tune, judge, report and export it. Stop it at any
    moment (Ctrl-C): the same command continues.

    Example: `edp simulate data/many --scenario examples/scenarios/many_machines.toml`, then
    `edp train pretrain data/many --out runs/foundation --set split.test_masses=[12,17]`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.config.experiment import load_experiment
    from edp.workflows.pretraining import PRETRAININGS, MetaSpec, Pretrain
    from edp.workflows.pretraining import pretrain as make

    check_effects(context, {"changes.pretrain": PRETRAININGS[method].episodic})
    meta, _ = command_settings("pretrain", MetaSpec, config, changes, TRAINING_TABLES)
    order = Pretrain(method=method, meta=meta, start=start)
    # Other splits are refused; the default makes the usual call short.
    experiment = load_experiment(config, preset, ['split.kind="machines"', *changes], aside=("pretrain",))
    with show_progress("pretrain", as_json) as progress:
        source = source_of(data, signal_map, repair)
        if cluster:
            progress.note(f"on a node of the cluster at {cluster}")
        workers = workers_of(1, cluster, open_cluster)
        result = make(source, experiment, order, folder, progress, workers)

    def show() -> None:
        _tables(result)
        out.print(f"next: edp train finetune {folder} LOGS --out RUN, or edp evaluate {folder}")

    emit(as_json, result.to_table() | {"run": str(folder)}, show)


def _tables(result: FoundationFile) -> None:
    """Machines of each part, and the errors on those that test."""
    from edp.report.run.tables import contexts_table, machine_parts_table

    for table in (machine_parts_table(result), contexts_table(result)):
        print_table(table)
        out.print()
