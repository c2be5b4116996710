"""``edp distil``: a smaller network that learns from a trained one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, Steps, duration, emit, out, progress, table
from edp.cli.train import MapOption, RepairOption, TrainingDisplay, source_of


def distil(
    run: Annotated[Path, typer.Argument(help="Run folder of the teacher.")],
    units: Annotated[int, typer.Option(help="Width of the student: recurrent units, or channels of the first level.")],
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    data: Annotated[
        Path | None, typer.Option(help="A log, a folder of logs, or a data-set file; default: those of the run.")
    ] = None,
    levels: Annotated[int | None, typer.Option(help="Convolution levels; default: one less than the teacher.")] = None,
    pruned: Annotated[
        bool, typer.Option(help="Initialise with the teacher's most important channels and units.")
    ] = False,
    truth: Annotated[
        float, typer.Option(help="Weight of the measured targets beside the teachers' predictions; 0: teachers only.")
    ] = 0.5,
    hint: Annotated[float, typer.Option(help="Weight of the hidden-feature hint.")] = 0.0,
    teachers: Annotated[list[Path], typer.Option("--teacher", help="A further teacher; may be repeated.")] = [],  # noqa: B006
    further: Annotated[
        Path | None,
        typer.Option(help="Recordings without measured targets; the student learns the teachers' predictions on them."),
    ] = None,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting of the training, for example training.epochs=10.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Train a smaller network of the same parts on measured targets and on predictions of a trained network.

    Stop it at any moment (Ctrl-C): the same command continues. The run is judged with `edp evaluate`.

    Example: `edp distil runs/first --units 32 --out runs/small`
    """
    from edp.evaluation.footprint import footprint
    from edp.training import load_bundle
    from edp.workflows.compression import DistillationSpec, DistilSpec
    from edp.workflows.compression import distil as make

    spec = DistilSpec(
        units=units,
        levels=levels,
        pruned=pruned,
        distillation=DistillationSpec(truth=truth, hint=hint),
        teachers=tuple(str(path) for path in teachers),
        further=None if further is None else source_of(further, signal_map, repair),
        changes=tuple(changes),
    )
    source = None if data is None else source_of(data, signal_map, repair)
    with progress(as_json) as shown:
        display = TrainingDisplay(shown, Steps(as_json))
        bundle = make(run, spec, folder, source, display.on_event)
    counts = {"teacher": footprint(load_bundle(run).predictor), "student": footprint(bundle.predictor)}
    facts = {
        "run": str(folder),
        "bundle": str(folder / "bundle"),
        "seconds": bundle.provenance["seconds"],
        "validation_mae": display.best,
        **{name: {"parameters": count.parameters, "macs_tick": count.macs_tick} for name, count in counts.items()},
    }

    def show() -> None:
        rows = [(name, count.parameters, count.macs_tick, count.macs_window) for name, count in counts.items()]
        table("", ["network", "parameters", "MACs per tick", "MACs per window"], rows)
        tail = "" if display.best is None else f", validation MAE {display.best:.4g} (report units)"
        out.print(f"distilled in {duration(bundle.provenance['seconds'])}{tail}; bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(as_json, facts, show)
