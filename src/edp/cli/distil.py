"""``edp compress distil``: a smaller network that learns from a trained one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edp.cli.console import JsonFlag, duration, emit, out, table
from edp.cli.options import DataOption, MapOption, RepairOption, SettingsOption, source_if_given
from edp.cli.progress import show_progress
from edp.errors import ConfigError
from edp.wording import figure

if TYPE_CHECKING:
    from edp.settings.tree import Change


def distil(
    run: Annotated[Path, typer.Argument(help="Run folder of the teacher.")],
    folder: Annotated[Path, typer.Option("--out", help="Run folder; an unfinished run continues.")],
    units: Annotated[
        int | None,
        typer.Option(help="Width of the student (distil.units): recurrent units, or channels of the first level."),
    ] = None,
    data: DataOption = [],  # noqa: B006
    teachers: Annotated[list[Path], typer.Option("--teacher", help="A further teacher; may be repeated.")] = [],  # noqa: B006
    unlabelled: Annotated[
        list[Path],
        typer.Option(
            help="Recordings without measured targets, on which the student learns the teachers' predictions; may be "
            "repeated."
        ),
    ] = [],  # noqa: B006
    config: SettingsOption = None,
    changes: Annotated[
        list[str], typer.Option("--set", help="One setting, such as distil.pruned=true or training.epochs=10.")
    ] = [],  # noqa: B006
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Train a smaller network of the same parts on measured targets and on predictions of a trained network.

    Stop it at any moment (Ctrl-C): the same command continues. The run is judged with `edp evaluate`.

    Example: `edp compress distil runs/first --units 32 --out runs/small`
    """
    from edp.config.commands import TRAINING_TABLES, command_settings
    from edp.evaluation.footprint import footprint
    from edp.training import load_bundle
    from edp.workflows.compression import DISTIL_SETTINGS, DistilRequest, DistilSpec
    from edp.workflows.compression import distil as make

    if units is None and config is None and not any(change.startswith("distil") for change in changes):
        raise ConfigError("the width of the student is missing; give it with --units, such as --units 64")
    layers: list[Change] = [*changes] if units is None else [*changes, {"distil": {"units": units}}]
    spec, others = command_settings("distil", DistilSpec, config, layers, TRAINING_TABLES, DISTIL_SETTINGS)
    request = DistilRequest(
        spec=spec,
        teachers=tuple(map(str, teachers)),
        further=source_if_given(unlabelled, signal_map, repair),
        changes=others,
    )
    source = source_if_given(data, signal_map, repair)
    with show_progress("distil", as_json) as progress:
        bundle = make(run, request, folder, source, progress)
    counts = {"teacher": footprint(load_bundle(run).predictor), "student": footprint(bundle.predictor)}
    seconds, error = bundle.provenance.seconds or 0.0, progress.display.measured("validation_mae")
    facts = {
        "run": str(folder),
        "bundle": str(folder / "bundle"),
        "seconds": seconds,
        "validation_mae": error,
        **{name: {"parameters": count.parameters, "macs_tick": count.macs_tick} for name, count in counts.items()},
    }

    def show() -> None:
        rows = [(name, count.parameters, count.macs_tick, count.macs_window) for name, count in counts.items()]
        table("", ["network", "parameters", "MACs per tick", "MACs per window"], rows)
        tail = "" if error is None else f", validation MAE {figure(error)} (report units)"
        out.print(f"distilled in {duration(seconds)}{tail}; bundle in {folder / 'bundle'}")
        out.print(f"next: edp evaluate {folder}")

    emit(as_json, facts, show)
