"""The house style of the figures: colours, names, axes, and the choices above a figure."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go

from edp.report.common.wording import short_label
from edp.report.run.facts import NETWORK, TRUTH, Facts, horizon_text, label_of

INK, SOFT, RULE = "#26303a", "#66717d", "#e4e8ec"
BLUE, GREY = "#0b57d0", "#3c4650"
MUTED = ("#c9892f", "#5a9c8c", "#a97da0", "#8b929a", "#a5a04a", "#b9705c")
MARKS = ("diamond", "square", "triangle-up", "x", "cross", "star")
FONT = 'Inter, "Helvetica Neue", "Segoe UI", Roboto, Arial, sans-serif'


@dataclass(frozen=True)
class Control:
    """A choice above a figure: traces whose `meta` names another option of `key` are hidden."""

    key: str
    label: str
    options: tuple[tuple[str, str], ...]
    keeps_zoom: bool = True


@dataclass(frozen=True)
class Plot:
    """A figure with the choices a reader has."""

    name: str
    figure: go.Figure
    controls: tuple[Control, ...] = ()

    def spec(self) -> dict[str, Any]:
        """What the page's script needs, ready for JSON."""
        keeps = {control.key: control.keeps_zoom for control in self.controls}
        return {"name": self.name, "figure": json.loads(self.figure.to_json()), "controls": keeps}


def colour(facts: Facts, model: str) -> str:
    """The network is blue and the truth dark grey everywhere; a baseline keeps one muted colour in all figures."""
    if model in (NETWORK, TRUTH):
        return BLUE if model == NETWORK else GREY
    # Colours repeat when the baselines outnumber them; marks and names still tell them apart.
    return MUTED[_place(facts, model) % len(MUTED)]


def _place(facts: Facts, model: str) -> int:
    names = [name for name in facts.models if name != NETWORK]
    return names.index(model) if model in names else len(names)


def mark(facts: Facts, model: str) -> str:
    """The marker of a model, so that colour is never the only difference."""
    return "circle" if model == NETWORK else MARKS[_place(facts, model) % len(MARKS)]


def name_of(facts: Facts, model: str) -> str:
    """Plotly reads a subset of HTML in its texts, so names from files are escaped."""
    return "Measured" if model == TRUTH else html.escape(short_label(label_of(facts, model)))


def styled(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """The house style: white ground, hairline grid, legend on top, no title (the page has one)."""
    figure.update_layout(
        template=go.layout.Template(),
        height=height,
        font={"family": FONT, "size": 13, "color": INK},
        paper_bgcolor="#ffffff",
        plot_bgcolor="#ffffff",
        margin={"l": 64, "r": 14, "t": 40, "b": 52},
        legend={"orientation": "h", "x": 0, "y": 1, "yref": "container", "yanchor": "top", "itemwidth": 30},
        hoverlabel={"bgcolor": "#ffffff", "bordercolor": RULE, "font": {"family": FONT, "size": 12, "color": INK}},
        modebar={"bgcolor": "rgba(0,0,0,0)", "color": "#b4bcc5", "activecolor": BLUE, "orientation": "h"},
        **layout,
    )
    axis = {
        "gridcolor": RULE,
        "linecolor": "#c4cbd2",
        "zeroline": False,
        "automargin": True,
        "tickfont": {"size": 12, "color": SOFT},
        "title": {"font": {"size": 12.5, "color": SOFT}, "standoff": 8},
    }
    figure.update_xaxes(showline=True, showgrid=False, ticks="outside", ticklen=4, tickcolor="#c4cbd2", **axis)
    figure.update_yaxes(**axis)
    figure.update_annotations(font={"size": 13, "color": INK})
    return figure


def horizon_control(facts: Facts, horizons: Sequence[int], keeps_zoom: bool = True) -> tuple[Control, ...]:
    """A selector of horizons, or none where there is no choice."""
    options = tuple((str(k), f"{horizon_text(facts, k)} ahead") for k in horizons)
    return (Control("horizon", "Horizon", options, keeps_zoom),) if len(options) > 1 else ()


def with_unit(text: str, unit: str) -> str:
    """An axis title, escaped, its unit in brackets."""
    return html.escape(f"{text} [{unit}]" if unit else text)


def error_title(facts: Facts) -> str:
    """Title of every axis of mean absolute error."""
    return with_unit("Mean absolute error", facts.unit)


def line_style(facts: Facts, name: str) -> dict[str, Any]:
    """Line, marker and legend place of a model in the error figures."""
    network = name == NETWORK
    return {
        "name": name_of(facts, name),
        "mode": "lines+markers",
        "hovertemplate": "%{y:.4~g}",
        "line": {"color": colour(facts, name), "width": 2.6 if network else 1.4},
        "marker": {"symbol": mark(facts, name), "size": 8 if network else 7},
        "legendrank": 1 if network else 10 + _place(facts, name),
    }
