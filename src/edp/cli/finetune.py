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
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished one goes on.")],
    method: Annotated[str, typer.Option(help="The method whose network is kept.")] = "full",
    baselines: Annotated[
        str, typer.Option(help="Comma-separated methods to compare with, 'all' or 'none'.")
    ] = "ridge_arx",
    head_epochs: Annotated[int, typer.Option(help="Epochs of phase 1, the head alone.")] = 15,
    epochs: Annotated[int, typer.Option(help="Epochs of phase 2, everything.")] = 25,
    head_rate: Annotated[float, typer.Option(help="Learning rate of the head in both phases.")] = 3e-4,
    backbone_rate: Annotated[float, typer.Option(help="Learning rate of the backbone in phase 2.")] = 1e-5,
    depth_decay: Annotated[float, typer.Option(help="Rate of a part of the backbone over that of the next.")] = 1.0,
    rounds: Annotated[int, typer.Option(help="Epochs of methods without phases.")] = 10,
    rate: Annotated[float, typer.Option(help="Learning rate of methods without phases.")] = 3e-3,
    batch: Annotated[int, typer.Option(help="Lanes of a chunk, or windows, of an update.")] = 32,
    smoothness: Annotated[float, typer.Option(help="Weight of the smoothness of predictions; 0: none.")] = 0.05,
    weight_decay: Annotated[float, typer.Option(help="Lambda of the weights' decay.")] = 1e-4,
    patience: Annotated[int, typer.Option(help="Epochs without gain before a phase ends; 0: never.")] = 8,
    rank: Annotated[int, typer.Option(help="Of the low-rank adapters.")] = 8,
    source_weight: Annotated[
        float, typer.Option(help="Weight of the source's loss, of methods that rehearse it.")
    ] = 1.0,
    soft: Annotated[float, typer.Option(help="Share of that loss that the source's network teaches.")] = 0.5,
    reversal: Annotated[float, typer.Option(help="Weight of the reversed gradient of the adversary.")] = 0.1,
    inner_rate: Annotated[
        float, typer.Option(help="Rate of few steps; 0: the source's own, where it was meta-learned.")
    ] = 0.0,
    inner_steps: Annotated[int, typer.Option(help="Most steps of the method of few steps.")] = 30,
    center: Annotated[bool, typer.Option(help="Take the mean error over the training logs out of the network.")] = True,
    any_sign: Annotated[bool, typer.Option("--any-sign", help="Take logs of another sign convention.")] = False,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting of the trainings, for example training.updates=100.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Train a network of one machine on with logs of another, and judge it beside baselines on the same ticks.

    Each log is divided by time: its beginning trains, a part validates, its end tests. The source's scaling is
    carried. What comes out is a run: judge, report and export it. Stop it at any moment (Ctrl-C): the same command
    goes on.

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
        watchers = FinetuneCallbacks(display.on_note, display.on_training, display.on_next)
        result = make(bundle, source, order, folder, watchers)
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
