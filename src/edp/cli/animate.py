"""``edp data animate``: the side view of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out
from edp.cli.options import MAX_SECONDS, MapOption, check_effects, parse_seconds, within
from edp.errors import ConfigError
from edp.settings.bounds import above, span
from edp.storage.paths import full_path

PAGES = (".html", ".htm")


def animate(
    context: typer.Context,
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="[RUN] LOG",
            help="A log with joint angles or cylinder strokes; before it, if given, a run whose predictions are drawn.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--out", help="The page (.html) or film (.mp4, .gif); default: beside the log.")
    ] = None,
    machine: Annotated[
        str | None, typer.Option(help="Machine name or file (.toml) to draw; default: the recording's.")
    ] = None,
    start: Annotated[
        float, typer.Option("--from", callback=within(span(0.0, MAX_SECONDS)), help="First second shown.")
    ] = 0.0,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--duration",
            parser=parse_seconds,
            metavar="TIME",
            callback=within(above(0.0, MAX_SECONDS)),
            help="Length that is shown, such as 90s; default: up to 600 s.",
        ),
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(min=1, help="Samples ahead of the run's predictions; default: its furthest.")
    ] = None,
    signal_map: MapOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Show a recording from the side: an offline page to play, with bucket path, soil, pressures and velocities.

    With a run before the log, its predictions and their intervals stand beside what then happened.

    Example: `edp data animate runs/m22 data/m22/m22_000_combined.parquet`
    """
    from edp.logs.source import DataSource, read_with_truth
    from edp.report.animation.film import FILMS, write_film
    from edp.report.animation.page import scene_of, write_animation

    run, log = _run_and_log(paths)
    check_effects(context, {"horizon": run is not None})
    target = output or log.parent / f"{log.stem or 'log'}.html"
    film = target.suffix.lower() in FILMS
    if not film and target.suffix.lower() not in PAGES:
        endings = ", ".join((*PAGES, *FILMS))
        raise ConfigError(f"--out {target}: an animation ends in one of {endings}, not in '{target.suffix}'")
    if film and run is not None:
        raise ConfigError(f"--out {target}: predictions of a run are drawn on a page (.html), not in a film")
    recording = read_with_truth(DataSource.from_path(log, signal_map))
    # The scene first: a log that cannot be drawn is refused before a model works through it.
    scene = scene_of(recording, machine, start, seconds)
    if run is not None:
        from edp.workflows.live.forecasts import forecast_lines

        scene = scene_of(recording, machine, start, seconds, forecast_lines(run, recording, horizon))
    (write_film if film else write_animation)(scene, target)

    def show() -> None:
        out.print(f"animation: {full_path(target)}")

    emit(as_json, {"animation": str(target)}, show)


def _run_and_log(paths: Sequence[Path]) -> tuple[Path | None, Path]:
    """Return the run, if one is given, and the log.

    Raises:
        ConfigError: more than these two.
    """
    if len(paths) > 2:
        raise ConfigError(f"edp data animate takes a log, or a run and a log; {len(paths)} paths were given")
    return (None if len(paths) == 1 else paths[0]), paths[-1]
