"""``edp control``: a controller in closed loop with a plant, along tasks of the bucket tip."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from edp.cli.console import JsonFlag, Steps, counted, emit, out, progress, table


def control(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder to write.")],
    task: Annotated[str, typer.Option(help="What to follow: grade, corners, level, point or dig.")] = "",
    machine: Annotated[str, typer.Option(help="Machine name or file (.toml).")] = "",
    controller: Annotated[str, typer.Option(help="What moves the levers, for example pi or inversion.")] = "",
    seeds: Annotated[
        int, typer.Option(min=0, help="Number of loops, each along a reference of its own; 0: as set.")
    ] = 0,
    plant: Annotated[Path | None, typer.Option(help="Run folder of a twin that is the plant instead.")] = None,
    twin: Annotated[Path | None, typer.Option(help="Run folder of a twin that the controller uses.")] = None,
    predictor: Annotated[Path | None, typer.Option(help="Run folder of edp train that the controller uses.")] = None,
    config: Annotated[Path | None, typer.Option(help="Settings (TOML).")] = None,
    changes: Annotated[list[str], typer.Option("--set", help="One setting, for example task.slope_deg=45.")] = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Run a controller in closed loop: scores, a recording a loop, and a page with paths, errors and levers.

    The plant is the simulator, or a twin with --plant. Position errors are to the reference of the same time; the
    distance to the path stands beside them.

    Example: `edp control runs/grade --task grade --machine M22 --controller pi --seeds 6`
    """
    from edp.config.control import load_control_experiment
    from edp.workflows.control import control_loops
    from edp.workflows.control.run_control import ControlSources

    options: dict[str, Any] = {"machine": machine} if machine else {}
    options |= {"loops": seeds} if seeds else {}
    options |= {"task": {"kind": task}} if task else {}
    options |= {"controller": {"kind": controller}} if controller else {}
    experiment = load_control_experiment(config, changes, options)
    with progress(as_json) as shown:
        on_loop = counted(shown, Steps(as_json), "control", "loops run")
        run = control_loops(experiment, folder, ControlSources(plant, twin, predictor), on_loop)

    def show() -> None:
        out.print(run.content["sentence"])
        score_table(run.content)
        out.print(f"page: {run.page.resolve()}")

    emit(as_json, {"run": str(folder), "page": str(run.page), **run.content}, show)


def score_table(content: dict[str, Any] | Any) -> None:
    """Print a row a loop."""
    rows = []
    for loop in content["loops"]:
        score = loop["score"]
        cells = [f"{score[key]:.1f}" for key in ("position_rms_mm", "position_max_mm", "path_rms_mm", "path_max_mm")]
        arrived = "-" if score["arrived_s"] is None else f"{score['arrived_s']:.2f}"
        energy = "-" if score["energy_kj"] is None else f"{score['energy_kj']:.0f}"
        cells += [f"{score['attitude_rms_deg']:.2f}", arrived, energy, f"{score['lever_travel']:.1f}"]
        rows.append([loop["name"], *cells, sum(score["violations"].values())])
    heads = [
        "position, mm",
        "max",
        "path, mm",
        "max",
        "attitude, deg",
        "arrived, s",
        "energy, kJ",
        "levers",
        "violated",
    ]
    table("errors (rms and largest), time, energy, lever travel and ticks beyond limits", ["", *heads], rows)
