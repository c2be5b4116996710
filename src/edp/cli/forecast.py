"""Command ``edp data add-forecasts``: add forecasts of a twin to logs as additional channels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edp.cli.console import JsonFlag, emit, out, table
from edp.cli.options import MOST_TICKS, LogsArgument, MapOption, RepairOption, source_of, within
from edp.cli.progress import show_progress
from edp.errors import count_of
from edp.settings.bounds import integer, span
from edp.settings.results import plain_value
from edp.wording import figure

MODELS = ("twin", "persistence")
"""In the scores, in the order of the table's columns."""


def forecast(
    run: Annotated[Path, typer.Argument(help="Run folder of edp twin.")],
    data: LogsArgument,
    folder: Annotated[Path, typer.Option("--out", help="New folder for the logs with forecasts (Parquet).")],
    horizon: Annotated[
        list[int],
        typer.Option(callback=within(integer(1, MOST_TICKS)), help="Prediction horizon in samples; may be repeated."),
    ] = [10],  # noqa: B006
    channel: Annotated[
        list[str], typer.Option(help="Channel to forecast; may be repeated. Default: the velocities.")
    ] = [],  # noqa: B006
    observer_gain: Annotated[
        float | None,
        typer.Option(
            callback=within(span(0.0, 1.0)),
            help="Gain of the observer, 0 to 1; default: the gain with the least error on the logs.",
        ),
    ] = None,
    signal_map: MapOption = None,
    repair: RepairOption = [],  # noqa: B006
    as_json: JsonFlag = False,
) -> None:
    """Add forecasts of a twin to logs, so that a network can learn the twin's residual error.

    At each tick an observer has followed the measured machine; from there the twin runs free with the commands held.
    The channel CylVels_1_in_10 is what it then says of CylVels_1 in ten ticks: a network with task.features = "all"
    reads it like any other channel. Prints how far off the forecasts are, beside holding the present value.

    Example: `edp data add-forecasts runs/twin logs --out logs_ahead --horizon 10`
    """
    from edp.workflows.twin import forecast_logs

    with show_progress("forecast", as_json) as progress:
        result = forecast_logs(
            run, source_of(data, signal_map, repair), horizon, folder, channel, observer_gain, progress
        )
    facts = {
        "folder": str(folder),
        "logs": len(result.files),
        "channels": result.channels,
        "gain": result.gain,
        "ahead": plain_value(result.scores),
    }

    def show() -> None:
        for row in result.scores.values():
            errors = [
                [
                    name,
                    row.twin.unit_of(name),
                    *(figure(one.by_channel[name], 3) for one in (row.twin, row.persistence)),
                ]
                for name in row.twin.by_channel
            ]
            title = f"{figure(row.seconds)} s ahead, commands held: mean absolute error at {row.moments:,} moments"
            table(title, ["", "unit", "twin", "present value held"], errors)
        out.print(f"gain of the observer: {figure(result.gain)}")
        out.print(f"{count_of(len(result.files), 'log')} in {folder}, each with {', '.join(result.channels)}")
        out.print(f"next: edp train {folder} --set task.features=all --out runs/ahead")

    emit(as_json, facts, show)
