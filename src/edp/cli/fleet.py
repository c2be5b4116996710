"""Command ``edp fleet``: report on many machines with one network, and the network of one machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, print_table
from edp.cli.options import ClusterOption, OpenOption, WorkersOption, workers_of
from edp.cli.progress import show_progress
from edp.storage.paths import full_path

app = typer.Typer(
    name="fleet",
    help="Evaluate one network on many machines, and fine-tune it for single machines.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)


@app.command("report")
def report(
    network: Annotated[Path, typer.Argument(help="Run folder or bundle of the fleet's network.")],
    store: Annotated[Path, typer.Argument(help="Store of recordings that say their machine.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the page and fleet_report.json.")],
    deltas: Annotated[
        Path | None, typer.Option(help="Folder of edp train finetune --fleet: each machine runs under its own delta.")
    ] = None,
    monitor: Annotated[Path | None, typer.Option(help="Monitor that watches every machine, too.")] = None,
    workers: WorkersOption = 1,
    cluster: ClusterOption = "",
    open_cluster: OpenOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Report on a fleet: machines by error, drift and alarms, and the anomalies of the ten worst.

    Example: `edp fleet report runs/foundation stores/fleet --out fleet --deltas fleet/own --workers 4`
    """
    from edp.report.fleet.facts import headline, machine_table, worst_table
    from edp.workflows.fleet.judge_fleet import PAGE, FleetQuestion, report_fleet

    question = FleetQuestion(network=network, store=store, deltas=deltas, monitor=monitor)
    with show_progress("judge", as_json) as progress:
        facts = report_fleet(workers_of(workers, cluster, open_cluster), question, folder, progress)
    page = full_path(folder / PAGE)

    def show() -> None:
        for table in (worst_table(facts), machine_table(facts)) if facts.rows else ():
            print_table(table)
            out.print()
        for name, why in facts.failed:
            out.print(f"'{name}' could not be judged: {why}")
        out.print(headline(facts))
        out.print(f"page: {page}")

    emit(as_json, {"page": str(page), "headline": headline(facts), **facts.report.to_json()}, show)


@app.command("network")
def network(
    deltas: Annotated[Path, typer.Argument(help="Folder of edp train finetune --fleet.")],
    machine: Annotated[str, typer.Argument(help="Name of the machine.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the bundle.")],
    base: Annotated[
        Path | None, typer.Option(help="Run folder or bundle of the fleet's network; default: where it lay.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write the network of one machine, the fleet's with its delta added, as a bundle to export.

    Example: `edp fleet network fleet/own "C14 no. 3" --out c14_3`, then `edp export c14_3 --format c --out exported`
    """
    from edp.workflows.fleet.personal import network_of

    written = network_of(deltas, machine, folder, base)

    def show() -> None:
        out.print(f"network of '{machine}' in {written}")
        out.print(f"next: edp export {written} --format c --out exported")

    emit(as_json, {"bundle": str(written), "machine": machine}, show)
