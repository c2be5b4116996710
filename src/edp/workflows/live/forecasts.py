"""Predictions along a whole log, each at the tick for which it was made, from the same parts as the live view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.live.layout import Forecast
from edp.recording import Recording
from edp.report.animation.page import ForecastLine
from edp.wording import typed
from edp.workflows.live.run_live import LiveOrder, LiveRun
from edp.workflows.live.sources import SourceOptions
from edp.workflows.live.sources.log import LogSource

MAX_LINES = 6
"""Maximum number of predictions on a page; each has a chart."""
MOST_BYTES = 1 << 30
"""Maximum size of the rows: an hour of 700 columns at 100 Hz."""


def forecast_lines(run: str | Path, recording: Recording, horizon: int | None = None) -> list[ForecastLine]:
    """Return the predictions of a run's network or twin along a recording, tick by tick, as on the machine.

    Args:
        run: run folder.
        recording: recording, used from its first row on, since models have memory.
        horizon: samples ahead; default: the furthest.

    Raises:
        ConfigError: the recording lacks what the model reads, has another rate, or the model has no such horizon.
    """
    order = LiveOrder("log", SourceOptions(""), run=Path(run), speed=float("inf"), history_bytes=MOST_BYTES)
    live = LiveRun(order, source=LogSource(recording))
    live.play()
    live.close()
    if live.failure is not None:
        raise live.failure
    layout, rows = live.session.layout, live.session.read(0, live.session.ticks)[1]
    ahead = sorted({one.ticks for one in layout.forecasts})
    chosen = ahead[-1] if horizon is None else horizon
    if chosen not in ahead:
        shown = ", ".join(map(str, ahead))
        raise ConfigError(f"--horizon {chosen}: this run predicts {shown} samples ahead; choose one of them")
    lines = [
        _line(one, one.measured, rows, layout.rate_hz)
        for one in layout.forecasts
        if one.ticks == chosen and one.measured is not None
    ]
    if not lines:
        raise ConfigError(f"the log holds nothing of what '{run}' predicts; map the columns that do (--map)")
    return lines[:MAX_LINES]


def _line(one: Forecast, measured: int, rows: NDArray[np.float32], rate_hz: float) -> ForecastLine:
    def shown(column: int, ticks: int) -> NDArray[np.float64]:
        later = np.full(len(rows), np.nan)
        later[ticks:] = rows[: len(rows) - ticks, column]
        return later * one.factor + one.offset

    ends = {
        name: None if column is None else shown(column, one.ticks)
        for name, column in (("lower", one.lower), ("upper", one.upper))
    }
    how = one.model if one.model != "network" else f"{typed(1e3 * one.ticks / rate_hz)} ms ahead"
    return ForecastLine(
        f"{one.name}, {how}", one.unit, shown(one.column, one.ticks), shown(measured, 0), ends["lower"],
        ends["upper"],
    )  # fmt: skip
