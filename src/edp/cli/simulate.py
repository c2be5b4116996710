"""``edp simulate``: a data set from the built-in excavator."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, Steps, duration, emit, out, progress

if TYPE_CHECKING:
    from edp.recording import Recording
    from edp.workflow import SimulationOrder


def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder for the logs; an unfinished data set goes on.")],
    machine: Annotated[str, typer.Option(help="M22, C14, or the path of a machine file (.toml).")] = "M22",
    minutes: Annotated[float, typer.Option(help="Length of all recordings together.")] = 60.0,
    recordings: Annotated[int, typer.Option(help="How many recordings.")] = 30,
    seed: Annotated[int, typer.Option(help="The same seed gives the same bits.")] = 0,
    family: Annotated[int, typer.Option(help="So many random machines of 10 to 50 t in place of one.")] = 0,
    form: Annotated[str, typer.Option("--format", help="Ending of the logs: parquet, csv or mat.")] = "parquet",
    layout: Annotated[str, typer.Option(help="Layout of MAT files: simulink, speedgoat, struct, dataset, ...")] = "",
    truth: Annotated[str, typer.Option(help="What only a simulation knows: with the rest, apart or without.")] = "",
    workers: Annotated[int, typer.Option(help="Processes; 0 for one a core.")] = 0,
    as_json: JsonFlag = False,
) -> None:
    """Simulate recordings of the built-in excavator in free air.

    Example: `edp simulate data/m22 --minutes 90 --recordings 30 --seed 1`
    """
    from edp.workflow import SimulationOrder

    suffix = f".{form.lstrip('.')}"
    files = {"suffix": suffix, "layout": layout, "truth": truth}
    order = SimulationOrder(machine=machine, minutes=minutes, recordings=recordings, seed=seed, family=family, **files)
    paths = run(folder, order, workers, as_json)
    made = f"{family} machines" if family else machine
    facts = {"folder": str(folder), "recordings": len(paths), "minutes": minutes, "machine": made, "seed": seed}

    def show() -> None:
        out.print(f"{len(paths)} recordings of {made}, {minutes:g} min, in {folder}")
        out.print(f"next: edp inspect {folder}   or   edp train {folder} --out runs/first")

    emit(as_json, facts, show)


def run(folder: Path, order: SimulationOrder, workers: int = 0, quiet: bool = False) -> list[Path]:
    """Simulate with a progress display."""
    from edp.workflow import simulate_data_set

    began, steps, made = time.monotonic(), Steps(quiet), {"kept": 0, "new": 0, "seconds": 0.0}
    with progress(quiet) as shown:
        bar = shown.add_task("simulate", total=order.recordings, note="")

        def on_done(recording: Recording, kept: bool) -> None:
            made["kept" if kept else "new"] += 1
            made["seconds"] += 0.0 if kept else recording.duration_s
            elapsed = time.monotonic() - began
            done = made["kept"] + made["new"]
            left = elapsed / max(1, made["new"]) * (order.recordings - done)
            note = f"{made['seconds'] / max(1e-9, elapsed):,.0f} simulated s per s"
            shown.update(bar, advance=1, note=note)
            steps.say(f"simulate: {done:g} of {order.recordings} recordings, {note}, {duration(left)} left")

        return simulate_data_set(folder, order, workers, on_done)
