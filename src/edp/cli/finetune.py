"""``edp finetune``: a network of one machine, trained on for another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, progress, table
from edp.cli.settings import SettingsOption
from edp.cli.train import MapOption, RepairOption, SeriesDisplay, source_of
from edp.cli.workforce import ClusterOption, OpenOption, WorkersOption, workforce_of

if TYPE_CHECKING:
    from edp.report.transfer.facts import Transfer


def finetune(
    bundle: Annotated[Path, typer.Argument(help="Run folder of the source, or its bundle.")],
    logs: Annotated[Path, typer.Argument(help="Logs of the target: a log, folder, data-set file, or store.")],
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    method: Annotated[str, typer.Option(help="Method whose network becomes the run.")] = "full",
    baselines: Annotated[
        str, typer.Option(help="Comma-separated methods to compare with, 'all' or 'none'.")
    ] = "ridge_arx",
    config: SettingsOption = None,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting, for example finetune.rate=1e-3 or training.updates=100.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Fine-tune a network of one machine with logs of another, and judge it beside baselines on the same ticks.

    Each log is divided by time: its beginning trains, a part validates, its end tests. The source's scaling is
    kept. The result is a run, which can be judged, reported and exported. After a stop (Ctrl-C) the same command
    continues.

    Example: `edp finetune runs/m22 logs/c14 --out runs/c14 --baselines all`

    Example: `edp finetune runs/m22 logs/c14 --out runs/c14 --set finetune.rounds=20 --set finetune.batch=16`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.report import read_transfer, write_transfer_page
    from edp.workflows.transfer import METHODS, FinetuneCallbacks, FinetuneRequest, FinetuneSpec
    from edp.workflows.transfer import finetune as make

    spec, others = command_settings("finetune", FinetuneSpec, config, changes, TRAINING_TABLES)
    order = FinetuneRequest(spec=spec, method=method, baselines=_named(baselines, tuple(METHODS)), changes=others)
    source = source_of(logs, signal_map, repair)
    with progress(as_json) as shown:
        display = SeriesDisplay(shown, as_json, "finetune", "method")
        callbacks = FinetuneCallbacks(display.on_note, display.on_training, display.on_next)
        workforce = workforce_of(workers, cluster, open_cluster)
        if workforce.alone:
            result = make(bundle, source, order, folder, callbacks)
        else:
            from edp.workflows.fleet.training import finetune_with

            result = finetune_with(workforce, bundle, source, order, folder, callbacks)
    page = write_transfer_page(folder)
    facts = read_transfer(folder)

    def show() -> None:
        _tables(facts)
        out.print(f"report: {page}")
        out.print(f"next: edp evaluate {folder}, or edp export {folder} --to c --out exported")

    emit(as_json, result | {"run": str(folder), "report": str(page)}, show)


def _named(baselines: str, every: tuple[str, ...]) -> tuple[str, ...]:
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
        for sheet in words.sheets_of(facts, horizon):
            table(sheet.caption, sheet.heads(), sheet.texts())
            out.print()
    out.print(words.headline(facts))
    for line in words.verdict(facts):
        out.print(line)
