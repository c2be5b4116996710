"""Figures for a notebook, each with one fixed choice, so that they need no script."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.evaluation.study import StudyFile
from edp.recording import Recording
from edp.report.common.chart import BLUE, GREY, Chart, ChartAxis, DataSeries, Mark, Panel, Range, append_unit
from edp.report.run.charts import horizon_chart
from edp.report.run.facts import Facts
from edp.report.run.figures import downsample
from edp.report.search.charts import study_charts
from edp.signals import KINDS, Channel
from edp.wording import label_by_name, short_labels

if TYPE_CHECKING:
    import plotly.graph_objects as go

POINTS = 4000
"""Maximum number of points of a line. Longer lines are thinned without loss of peaks."""
Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class BandLine:
    """A target over time, SI units.

    Attributes:
        channel: the target.
        predicted: float ``(time,)`` at the tick that it speaks of; NaN where nothing was said.
        measured: measured values; None if not recorded.
        lower, upper: bounds of an interval; None where there is none.
    """

    channel: Channel
    predicted: Array
    measured: Array | None = None
    lower: Array | None = None
    upper: Array | None = None


def recordings_figure(recording: Recording, channels: Sequence[str]) -> go.Figure:
    """Return the channels of a recording over time, a row each, in the units of reports."""
    columns = [recording.channels[recording.index(name)] for name in channels]
    panels, labels = [], label_by_name(channels)
    for channel in columns:
        values, label = recording.column(channel.name), labels[channel.name]
        panels.append(_row(channel, label, [_line(channel, values, recording.rate_hz, label, BLUE, 1.4)]))
    return _figure(replace(_rows("recordings", panels), legend="none"))


def prediction_figure(lines: Sequence[BandLine], rate_hz: float, title: str) -> go.Figure:
    """Return predictions over measurements, one row per target, with intervals if present."""
    panels, labels = [], label_by_name(line.channel.name for line in lines)
    for line in lines:
        marks: list[Mark] = []
        if line.lower is not None and line.upper is not None:
            # Both bounds at the same places, or the area between them would not close.
            shown = np.union1d(downsample(line.lower, POINTS // 2), downsample(line.upper, POINTS // 2))
            low, high = (_convert_to_report_unit(bound, line.channel)[shown] for bound in (line.lower, line.upper))
            marks.append(Range(x=_seconds(shown, rate_hz), low=_small(low), high=_small(high), name="Interval"))
        if line.measured is not None:
            marks.append(_line(line.channel, line.measured, rate_hz, "Measured", GREY, 2.6))
        marks.append(_line(line.channel, line.predicted, rate_hz, "Predicted", BLUE, 1.5))
        panels.append(_row(line.channel, labels[line.channel.name], marks))
    return _figure(_rows("predictions", panels), title=short_labels([title])[0])


def score_figure(facts: Facts) -> go.Figure:
    """Return the root-mean-square error of every evaluated model, against the horizon if there are several."""
    chart = horizon_chart(facts)
    if chart is None:
        raise ConfigError("there are no scores to draw; judge the predictor first")
    return _figure(chart)


def study_figure(study: StudyFile, name: str | None = None) -> go.Figure:
    """Return a figure of a study by name; the default is the first one with data.

    Raises:
        ConfigError: there is no such figure, or no phase is decided yet.
    """
    charts = {chart.name: chart for chart in study_charts(study)}
    if not charts:
        raise ConfigError(f"the study of '{study.title}' has nothing to draw yet: no phase of it is decided")
    if name is not None and name not in charts:
        raise ConfigError(f"this study has no figure '{name}'{closest(name, charts)}")
    # Nothing in a notebook can choose, so that it shows the first option alone.
    return _figure(charts[name or next(iter(charts))].first())


def _rows(name: str, panels: Sequence[Panel]) -> Chart:
    # Many rows are lower, so that they fit a screen.
    height = 90 + (215 if len(panels) <= 4 else 130) * len(panels)
    return Chart(name, tuple(panels), height=height, together=True)


def _row(channel: Channel, label: str, marks: Sequence[Mark]) -> Panel:
    return Panel(tuple(marks), ChartAxis("Time [s]"), title=append_unit(label, KINDS[channel.kind].report_unit))


def _line(channel: Channel, values: Array, rate_hz: float, name: str, colour: str, width: float) -> DataSeries:
    shown = downsample(values, POINTS)
    y = _small(_convert_to_report_unit(values, channel)[shown])
    return DataSeries(x=_seconds(shown, rate_hz), y=y, name=name, colour=colour, width=width)


def _seconds(samples: NDArray[np.intp], rate_hz: float) -> NDArray[np.float32]:
    return (samples / rate_hz).astype(np.float32)


def _small(values: Array) -> NDArray[np.float32]:
    return values.astype(np.float32)


def _convert_to_report_unit(values: Array, channel: Channel) -> Array:
    return np.asarray(KINDS[channel.kind].to_report(values.astype(np.float64)), dtype=np.float64)


def _figure(chart: Chart, title: str = "") -> go.Figure:
    # Plotly takes half a second to import, which `edp.read` alone should not cost.
    from edp.report.notebook.display import show_chart

    return show_chart(chart, title)
