"""Command ``edp train finetune``: adapt a network of one machine to another machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, print_table, table
from edp.cli.options import (
    ClusterOption,
    MapOption,
    OpenOption,
    RepairOption,
    SettingsOption,
    WorkersOption,
    source_of,
    workers_of,
)
from edp.cli.progress import show_progress
from edp.cli.verdicts import end_with, show_verdict, verdict_facts
from edp.errors import ConfigError
from edp.wording import figure

if TYPE_CHECKING:
    from edp.jobs import Workers
    from edp.report.transfer.facts import Transfer
    from edp.workflows.fleet.personal import PersonalOrder


def finetune(
    bundle: Annotated[Path, typer.Argument(help="Run folder of the source, or its bundle.")],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="LOGS...", help="Logs of the target: logs and folders; or one data-set file, or one store."
        ),
    ] = None,
    *,
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    method: Annotated[str, typer.Option(help="Method whose network becomes the run.")] = "full",
    baselines: Annotated[
        str, typer.Option(help="Comma-separated methods to compare with, 'all' or 'none'.")
    ] = "ridge_arx",
    config: SettingsOption = None,
    changes: Annotated[
        list[str],
        typer.Option("--set", help="One setting, for example finetune.learning_rate=1e-3 or training.updates=100."),
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    fleet: Annotated[
        Path | None, typer.Option(help="In place of LOGS: a store of many machines, each of which gets a delta.")
    ] = None,
    delta_kb: Annotated[
        int | None, typer.Option("--delta-kb", min=8, max=16384, help="With --fleet: size of a delta; default: 64.")
    ] = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Fine-tune a network trained on one machine with logs of another, and compare it with baselines.

    Each log is divided by time: its beginning trains, a part validates, its end tests. The source's scaling is
    kept. The result is a run, which can be judged, reported and exported. After a stop (Ctrl-C) the same command
    continues.

    Example: `edp train finetune runs/m22 logs/c14 --out runs/c14 --baselines all`

    Example: `edp train finetune runs/m22 logs/c14 --out runs/c14 --set finetune.single_phase_epochs=20 --set
    finetune.batch=16`

    With --fleet a store of many machines is taken, and what comes out is a delta of kilobytes for each of them.

    Example: `edp train finetune runs/foundation --fleet stores/fleet --out fleet/own --workers 4`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.report import read_transfer, write_transfer_page
    from edp.report.transfer.facts import transfer_verdict
    from edp.workflows.transfer import METHODS, FinetuneRequest, FinetuneSpec
    from edp.workflows.transfer import finetune as make

    spec, others = command_settings("finetune", FinetuneSpec, config, changes, TRAINING_TABLES)
    divided = workers_of(workers, cluster, open_cluster)
    if fleet is not None:
        if logs or signal_map is not None or repair:
            raise ConfigError("LOGS, --map and --repair do not go with --fleet, whose store holds mapped logs already")
        from edp.workflows.fleet.personal import PersonalOrder

        size = {} if delta_kb is None else {"most_bytes": 1024 * delta_kb}
        personal = PersonalOrder(method=method, spec=spec, changes=others, **size)
        _finetune_fleet(bundle, fleet, folder, personal, divided, as_json)
        return
    if not logs or delta_kb is not None:
        raise ConfigError("give LOGS of one machine, or --fleet with a store of many, to which --delta-kb belongs")
    order = FinetuneRequest(
        spec=spec, method=method, baselines=_parse_baselines(baselines, tuple(METHODS)), changes=others
    )
    source = source_of(logs, signal_map, repair)
    with show_progress("finetune", as_json) as progress:
        result = make(bundle, source, order, folder, progress, divided)
    page = write_transfer_page(folder)
    facts = read_transfer(folder)

    verdict = transfer_verdict(facts)

    def show() -> None:
        show_verdict(verdict)
        _tables(facts)
        out.print(f"report: {page}")
        out.print(f"next: edp evaluate {folder}, or edp export {folder} --format c --out exported")

    emit(as_json, result.to_table() | {"run": str(folder), "report": str(page)} | verdict_facts(verdict), show)
    end_with(verdict)


def _finetune_fleet(
    bundle: Path, store: Path, folder: Path, order: PersonalOrder, workers: Workers, as_json: bool
) -> None:
    """Fine-tune for every machine of a store with a progress display, and print the results."""
    from edp.workflows.fleet.personal import finetune_fleet

    with show_progress("finetune", as_json) as progress:
        content = finetune_fleet(workers, bundle, store, order, folder, progress)

    def show() -> None:
        rows = [
            (name, figure(error.before), figure(error.full), figure(error.delta))
            for name, error in content.errors.items()
        ]
        unit = content.unit
        heads = ["machine", f"before [{unit}]", f"full fine-tune [{unit}]", f"its delta [{unit}]"]
        table(f"mean absolute error, k = {content.horizon}, ends of the recordings", heads, rows)
        for row in content.machines:
            if row.failed is not None:
                out.print(f"'{row.machine}' has no delta: {row.failed}")
        out.print(f"deltas in {folder}")
        out.print(f"next: edp fleet report {bundle} {store} --deltas {folder} --out report")

    emit(as_json, content.to_table(), show)


def _parse_baselines(baselines: str, every: tuple[str, ...]) -> tuple[str, ...]:
    """Names of methods from the text of ``--baselines``."""
    special = {"all": every, "none": ()}
    return (
        special[baselines]
        if baselines in special
        else tuple(name.strip() for name in baselines.split(",") if name.strip())
    )


def _tables(facts: Transfer) -> None:
    from edp.report.transfer import facts as words

    for horizon in facts.horizons:
        for one in words.transfer_tables(facts, horizon):
            print_table(one)
            out.print()
    out.print(words.headline(facts))
    for line in words.verdict(facts):
        out.print(line)
