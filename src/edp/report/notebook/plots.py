"""Figures for a notebook: one choice of what is shown each, so that they need no script around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from edp.errors import ConfigError, closest
from edp.recording import Recording
from edp.report.common.style import BLUE, GREY, styled, with_unit
from edp.report.common.wording import printable, short_label
from edp.report.run.facts import Facts
from edp.report.run.figures import downsample
from edp.report.run.plots import horizon_plot
from edp.report.search.facts import StudyFacts
from edp.report.search.plots import study_plots
from edp.signals import KINDS, UNITS, Channel

POINTS = 4000
"""Of a drawn line; longer ones lose samples, but no peaks."""
BAND = "rgba(11,87,208,0.18)"
Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class BandLine:
    """A target over time, SI units.

    Attributes:
        channel: the target.
        predicted: float ``(time,)`` at the tick that it speaks of; NaN where nothing was said.
        measured: the same; None where it was not recorded.
        lower, upper: bounds of an interval; None where there is none.
    """

    channel: Channel
    predicted: Array
    measured: Array | None = None
    lower: Array | None = None
    upper: Array | None = None


def recordings_figure(recording: Recording, channels: Sequence[str]) -> go.Figure:
    """Channels of a recording over time, a row each, in the units of reports."""
    columns = [recording.channels[recording.index(name)] for name in channels]
    figure = _rows([_label(channel) for channel in columns])
    for row, channel in enumerate(columns, 1):
        values = _in_report_unit(recording.column(channel.name), channel)
        _line(figure, row, values, recording.rate_hz, name=_name(channel.name), colour=BLUE, width=1.4)
    return _finished(figure, len(columns), legend=False)


def prediction_figure(lines: Sequence[BandLine], rate_hz: float, title: str) -> go.Figure:
    """Predictions over what was measured, a row a target, with the interval where there is one."""
    figure = _rows([_label(line.channel) for line in lines])
    for row, line in enumerate(lines, 1):
        if line.lower is not None and line.upper is not None:
            for bound, fill in ((line.lower, None), (line.upper, "tonexty")):
                values = _in_report_unit(bound, line.channel)
                _line(figure, row, values, rate_hz, name="Interval", colour=BAND, width=0.5, fill=fill)
        if line.measured is not None:
            values = _in_report_unit(line.measured, line.channel)
            _line(figure, row, values, rate_hz, name="Measured", colour=GREY, width=2.6)
        values = _in_report_unit(line.predicted, line.channel)
        _line(figure, row, values, rate_hz, name="Predicted", colour=BLUE, width=1.5)
    shown: set[str] = set()
    for trace in figure.data:  # one entry of the legend for all rows
        trace.showlegend = trace.name not in shown and (trace.name != "Interval" or trace.fill == "tonexty")
        shown |= {trace.name} if trace.showlegend else set()
    _finished(figure, len(lines), legend=True)
    figure.update_layout(title={"text": _name(title), "font": {"size": 14}}, margin_t=90)
    return figure


def score_figure(facts: Facts) -> go.Figure:
    """Mean absolute error of every judged model, against the horizon where there are several."""
    plot = horizon_plot(facts)
    if plot is None:
        raise ConfigError("there are no scores to draw; judge the predictor first")
    return plot.figure


def study_figure(study: StudyFacts, name: str | None = None) -> go.Figure:
    """A figure of a study by name; without one the first that there are facts for.

    Raises:
        ConfigError: there is no such figure, or no phase is decided yet.
    """
    plots = study_plots(study)
    if not plots:
        raise ConfigError(f"the study of '{study.title}' has nothing to draw yet: no phase of it is decided")
    if name is not None and name not in plots:
        raise ConfigError(f"this study has no figure '{name}'{closest(name, plots)}")
    plot = plots[name or next(iter(plots))]
    figure = go.Figure(plot.figure)
    figure.data = tuple(trace for trace in figure.data if trace.visible is not False)
    return figure


def _rows(titles: Sequence[str]) -> go.Figure:
    spacing = 0.18 / max(len(titles), 2)
    return make_subplots(rows=len(titles), cols=1, shared_xaxes=True, vertical_spacing=spacing, subplot_titles=titles)


def _finished(figure: go.Figure, rows: int, legend: bool) -> go.Figure:
    styled(figure, 90 + (215 if rows <= 4 else 130) * rows, hovermode="x unified", showlegend=legend)
    figure.update_xaxes(title_text="Time [s]", row=rows, col=1)
    figure.update_annotations(x=0, xanchor="left")
    figure.update_layout(margin_t=66)
    return figure


def _line(
    figure: go.Figure,
    row: int,
    values: Array,
    rate_hz: float,
    *,
    name: str,
    colour: str,
    width: float,
    fill: str | None = None,
) -> None:
    shown = downsample(values, POINTS)
    figure.add_scatter(
        x=(shown / rate_hz).astype(np.float32),
        y=values[shown].astype(np.float32),
        row=row,
        col=1,
        mode="lines",
        name=name,
        legendgroup=name,
        fill=fill,
        fillcolor=BAND if fill else None,
        line={"color": colour, "width": width},
        hovertemplate="%{y:.4~g}",
    )


def _unit(channel: Channel) -> tuple[str, float]:
    """The unit of reports and its factor; the SI unit where a factor alone does not lead there (degrees Celsius)."""
    facts = KINDS[channel.kind]
    unit = UNITS.get(facts.report_unit)
    # A factor alone does not lead from kelvin to degrees Celsius.
    shifted = unit is not None and unit.offset != 0
    return (facts.si_unit, 1.0) if shifted else (facts.report_unit, facts.report_factor)


def _in_report_unit(values: Array, channel: Channel) -> Array:
    return np.asarray(values * _unit(channel)[1], dtype=np.float64)


def _label(channel: Channel) -> str:
    return with_unit(short_label(printable(channel.name)), _unit(channel)[0])


def _name(text: str) -> str:
    """Plotly reads a subset of HTML in its texts."""
    return with_unit(short_label(printable(text)), "")
