"""``edp animate``: the side view of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out
from edp.cli.train import MapOption
from edp.errors import ConfigError

PAGES = (".html", ".htm")


def animate(
    log: Annotated[Path, typer.Argument(help="A log with joint angles or cylinder strokes.")],
    output: Annotated[
        Path | None, typer.Option("--out", help="The page (.html) or film (.mp4, .gif); default: beside the log.")
    ] = None,
    machine: Annotated[
        str | None, typer.Option(help="Machine name or file (.toml) to draw; default: the recording's.")
    ] = None,
    start: Annotated[float, typer.Option(help="First second shown.")] = 0.0,
    seconds: Annotated[float | None, typer.Option(help="How many seconds; default: up to 600.")] = None,
    signal_map: MapOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show a recording from the side: an offline page to play, with bucket path, soil, pressures and velocities.

    Example: `edp animate data/m22/m22_000_combined.parquet`
    """
    from edp.logs.source import DataSource, read_with_truth
    from edp.report.animation.film import FILMS, write_film
    from edp.report.animation.page import scene_of, write_animation

    target = output or log.with_name(f"{log.stem}.html")
    scene = scene_of(read_with_truth(DataSource.of(log, signal_map)), machine, start, seconds)
    film = target.suffix.lower() in FILMS
    if not film and target.suffix.lower() not in PAGES:
        endings = ", ".join((*PAGES, *FILMS))
        raise ConfigError(f"--out {target}: an animation ends in one of {endings}, not in '{target.suffix}'")
    (write_film if film else write_animation)(scene, target)

    def show() -> None:
        out.print(f"animation: {target.resolve()}")

    emit(as_json, {"animation": str(target)}, show)
