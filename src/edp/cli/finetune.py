"""``edp finetune``: a network of one machine, trained on for another."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, progress, table
from edp.cli.train import MapOption, RepairOption, SeriesDisplay, source_of

if TYPE_CHECKING:
    from edp.report.transfer.facts import Transfer


def finetune(
    context: typer.Context,
    bundle: Annotated[Path, typer.Argument(help="Run folder of the source, or its bundle.")],
    logs: Annotated[Path, typer.Argument(help="Logs of the target: a log, a folder of logs, or a data-set file.")],
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    method: Annotated[str, typer.Option(help="Method whose network becomes the run.")] = "full",
    baselines: Annotated[
        str, typer.Option(help="Comma-separated methods to compare with, 'all' or 'none'.")
    ] = "ridge_arx",
    head_epochs: Annotated[int, typer.Option(help="Epochs of phase 1, in which only the head is trained.")] = 15,
    epochs: Annotated[int, typer.Option(help="Epochs of phase 2, in which all weights are trained.")] = 25,
    head_rate: Annotated[float, typer.Option(help="Learning rate of the head in both phases.")] = 3e-4,
    backbone_rate: Annotated[float, typer.Option(help="Learning rate of the backbone in phase 2.")] = 1e-5,
    depth_decay: Annotated[
        float, typer.Option(help="Ratio of the learning rates of consecutive parts of the backbone.")
    ] = 1.0,
    rounds: Annotated[int, typer.Option(help="Epochs of methods without phases.")] = 10,
    rate: Annotated[float, typer.Option(help="Learning rate of methods without phases.")] = 3e-3,
    batch: Annotated[int, typer.Option(help="Batch size: parallel chunks, or windows, of an update.")] = 32,
    smoothness: Annotated[float, typer.Option(help="Weight of the smoothness penalty on predictions; 0: none.")] = 0.05,
    weight_decay: Annotated[float, typer.Option(help="Weight decay.")] = 1e-4,
    patience: Annotated[int, typer.Option(help="Epochs without improvement before a phase ends; 0: no limit.")] = 8,
    rank: Annotated[int, typer.Option(help="Rank of the low-rank adapters.")] = 8,
    source_weight: Annotated[
        float, typer.Option(help="Weight of the loss on source recordings (rehearsal methods).")
    ] = 1.0,
    soft: Annotated[
        float, typer.Option(help="Share of that loss computed against predictions of the source network.")
    ] = 0.5,
    reversal: Annotated[float, typer.Option(help="Weight of the reversed gradient (method adversarial).")] = 0.1,
    inner_rate: Annotated[
        float, typer.Option(help="Learning rate of method few_steps; 0: that of the source's meta-learning.")
    ] = 0.0,
    inner_steps: Annotated[int, typer.Option(help="Maximum number of steps of method few_steps.")] = 30,
    center: Annotated[
        bool, typer.Option(help="Remove the mean error over the training logs from the output bias.")
    ] = True,
    any_sign: Annotated[bool, typer.Option("--any-sign", help="Accept logs of another sign convention.")] = False,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting of the trainings, for example training.updates=100.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Fine-tune a network of one machine with logs of another, and judge it beside baselines on the same ticks.

    Each log is divided by time: its beginning trains, a part validates, its end tests. The source's scaling is
    kept. The result is a run, which can be judged, reported and exported. After a stop (Ctrl-C) the same command
    continues.

    Example: `edp finetune runs/m22 logs/c14 --out runs/c14 --baselines all`
    """
    from edp.report import read_transfer, write_transfer_page
    from edp.workflows.transfer import METHODS, FinetuneCallbacks, FinetuneRequest, FinetuneSpec
    from edp.workflows.transfer import finetune as make

    named = [field.name for field in fields(FinetuneSpec) if field.name in context.params]
    spec = FinetuneSpec(**{name: context.params[name] for name in named}, check_signs=not any_sign)
    order = FinetuneRequest(
        spec=spec, method=method, baselines=_named(baselines, tuple(METHODS)), changes=tuple(changes)
    )
    source = source_of(logs, signal_map, repair)
    with progress(as_json) as shown:
        display = SeriesDisplay(shown, as_json, "finetune", "method")
        callbacks = FinetuneCallbacks(display.on_note, display.on_training, display.on_next)
        result = make(bundle, source, order, folder, callbacks)
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
