"""Draws a chart on a page, by plotly: zoom, values under the pointer, choices above it."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from edp.report.common.chart import (
    BLUE,
    FRAME,
    INK,
    RULE,
    SOFT,
    Bars,
    Cells,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Evenly,
    GuideLine,
    Mark,
    Positions,
    Range,
    Texts,
    fits,
)
from edp.wording import printable_lines

FONT = 'Inter, "Helvetica Neue", "Segoe UI", Roboto, Arial, sans-serif'
SYMBOLS = {"triangle": "triangle-up", "ring": "circle-open", "tick": "line-ns-open", "dash": "line-ew-open"}
STEPS = {"": "linear", "after": "hv", "middle": "hvh"}
LEGENDS = {
    "top": {"orientation": "h", "x": 0, "y": 1, "yref": "container", "yanchor": "top", "itemwidth": 30},
    "right": {"orientation": "v", "x": 1.01, "y": 1, "yref": "paper", "xanchor": "left"},
    "none": {},
}
Trace = dict[str, object]
"""Trace of a figure as in plotly's JSON."""
_FIELD = re.compile(r"\{(x|y|z|label)(?::([^{}]*?)(g?))?\}")


@dataclass(frozen=True)
class Plot:
    """A figure with the choices a reader has."""

    name: str
    figure: go.Figure
    controls: tuple[Control, ...] = ()

    def spec(self) -> dict[str, object]:
        """Return the data of the page's script, ready for JSON."""
        keeps = {control.key: control.keeps_zoom for control in self.controls}
        return {"name": self.name, "figure": json.loads(self.figure.to_json()), "controls": keeps}


def plots(charts: Iterable[Chart]) -> dict[str, Plot]:
    """Return every chart as a figure of a page, by name."""
    return {chart.name: plot(chart) for chart in charts}


def plot(chart: Chart, title: str = "") -> Plot:
    """Return a chart as a figure of a page with the first option of each choice.

    `title` is for figures without a heading.
    """
    grid = _grid(chart)
    # A figure is made of plain tables at once: each later change costs plotly as much as making it.
    layout = grid.to_plotly_json()["layout"]
    _put(layout, _frame(chart))
    if title:
        _put(layout, {"title": {"text": _text(title), "font": {"size": 14}}, "margin": {"t": 90}})
    for note in layout.get("annotations", ()):
        _put(note, {"font": {"size": 13, "color": INK}} | ({"x": 0, "xanchor": "left"} if chart.columns == 1 else {}))
    chosen = {control.key: control.options[0][0] for control in chart.choices}
    named: set[tuple[str, str]] = set()
    traces: list[Trace] = []
    for index, panel in enumerate(chart.panels):
        row, col = divmod(index, chart.columns)
        sides = [
            grid.get_subplot(row + 1, col + 1, secondary_y=second) for second in (False, True)[: 1 + bool(panel.second)]
        ]
        for mark in panel.marks:
            across, upwards = _refs(sides[-1 if mark.second else 0])
            if isinstance(mark, GuideLine):
                layout.setdefault("shapes", []).append(_rule(mark, *_refs(sides[0])))
                continue
            for trace in _traces(mark):
                # Plotly shows an entry for each trace; marks of one name are one thing to a reader.
                entry = (mark.name, json.dumps(dict(mark.when), sort_keys=True))
                trace |= {
                    "name": _text(mark.name), "legendgroup": _text(mark.group or mark.name),
                    "showlegend": bool(mark.name) and trace.get("showlegend") is not False and entry not in named,
                    "visible": fits(mark, chosen), "meta": dict(mark.when) or None,
                    "xaxis": across, "yaxis": upwards,
                }  # fmt: skip
                named |= {entry} if trace["showlegend"] else set()
                traces.append(trace)
        last = not chart.together or row == chart.rows - 1
        _put(layout[sides[0].xaxis.plotly_name], _axis(panel.x if last else replace(panel.x, title=""), upright=False))
        for side, axis in zip(sides, (panel.y, panel.second)):
            if axis is not None:
                _put(layout[side.yaxis.plotly_name], _axis(axis, upright=True))
    figure = go.Figure(data=traces, layout=layout)
    return Plot(chart.name, figure, tuple(c for c in chart.choices if len(c.options) > 1 or c.alone))


def _put(table: dict[str, Any], changes: Mapping[str, object]) -> None:
    """Put changes into a table, key by key; nested tables keep their other keys."""
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            _put(table[key], value)
        else:
            table[key] = value


def _refs(side: Any) -> tuple[str, str]:
    """Return the names by which traces refer to the axes of a panel."""
    return side.xaxis.plotly_name.replace("axis", ""), side.yaxis.plotly_name.replace("axis", "")


def _grid(chart: Chart) -> go.Figure:
    """Return the figure with the axes of all panels in their places."""
    rows, columns = chart.rows, chart.columns
    across = len(chart.shares) == columns > 1
    shares = {"column_widths" if across else "row_heights": list(chart.shares)} if chart.shares else {}
    titles = [_text(panel.title) for panel in chart.panels]
    apart = 0.26 if any(panel.y.title for index, panel in enumerate(chart.panels) if index % columns) else 0.18
    specs: list[dict[str, bool] | None] = [{"secondary_y": panel.second is not None} for panel in chart.panels]
    specs += [None] * (rows * columns - len(specs))
    return make_subplots(
        rows=rows, cols=columns, shared_xaxes=chart.together, shared_yaxes=across,
        # A gap takes the title and the tick texts of a row: the more rows, the smaller its share.
        vertical_spacing=(0.18 if chart.together else 0.3) / max(rows, 2),
        horizontal_spacing=0.02 if across else apart / columns, subplot_titles=titles if any(titles) else None,
        specs=[specs[row * columns : (row + 1) * columns] for row in range(rows)], **shares,
    )  # fmt: skip


def _frame(chart: Chart) -> dict[str, object]:
    """Return the layout of all panels: margins, legend, font, colours."""
    top = (46 if any(panel.title for panel in chart.panels) else 26) + (0 if chart.legend == "none" else 20)
    return {
        "template": go.layout.Template(),
        "height": chart.height,
        "font": {"family": FONT, "size": 13, "color": INK},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 64, "r": 190 if chart.legend == "right" else 14, "t": top, "b": 52},
        "legend": LEGENDS[chart.legend] | {"tracegroupgap": 0},
        "showlegend": chart.legend != "none",
        "hoverlabel": {"bgcolor": "#ffffff", "bordercolor": RULE, "font": {"family": FONT, "size": 12, "color": INK}},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#b4bcc5", "activecolor": BLUE, "orientation": "h"},
        "hovermode": "x unified" if chart.together else "closest",
        "bargap": 0.34,
    }


def _axis(axis: ChartAxis, upright: bool) -> dict[str, object]:
    options: dict[str, object] = {
        "visible": axis.shown,
        "gridcolor": RULE,
        "linecolor": FRAME,
        "automargin": True,
        "tickfont": {"size": 11 if axis.small else 12, "color": SOFT},
        "title": {"text": _text(axis.title), "font": {"size": 12.5, "color": SOFT}, "standoff": 8},
        "showgrid": upright if axis.grid is None else axis.grid,
        "zeroline": bool(axis.zero),
        "zerolinecolor": axis.zero or None,
        "type": {"names": "category", "linear": "-"}.get(axis.kind, axis.kind),
        "rangemode": "tozero" if axis.from_zero else "normal",
    }
    if not upright:
        options |= {"showline": True, "ticks": "outside", "ticklen": 4, "tickcolor": FRAME}
    if axis.ticks:
        options |= {"tickvals": [at for at, _ in axis.ticks], "ticktext": [_text(text) for _, text in axis.ticks]}
    elif axis.kind != "linear":
        options |= {"dtick": 1, "exponentformat": "e"}
    if axis.limits is not None:
        low, high = map(math.log10, axis.limits) if axis.kind == "log" else axis.limits
        options["range"] = [high, low] if axis.upside_down else [low, high]
    elif axis.upside_down:
        options["autorange"] = "reversed"
    return options | ({"tickangle": -axis.slant} if axis.slant else {})


def _rule(rule: GuideLine, across: str, upwards: str) -> dict[str, object]:
    """Return a line or a stripe through a panel, from edge to edge, as a shape."""
    way, other = ("x", "y") if rule.x is not None else ("y", "x")
    at = rule.x if rule.x is not None else rule.y
    refs = {"x": across, "y": upwards}
    shape: dict[str, object] = {
        f"{way}0": at, f"{way}1": at if rule.to is None else rule.to, f"{way}ref": refs[way],
        f"{other}0": 0, f"{other}1": 1, f"{other}ref": f"{refs[other]} domain",
    }  # fmt: skip
    if rule.to is None:
        line = {"color": rule.colour, "width": rule.width, "dash": rule.dash}
        return shape | {"type": "line", "line": line, "layer": "between"}
    return shape | {"type": "rect", "fillcolor": rule.colour, "line": {"width": 0}, "layer": "below"}


@singledispatch
def _traces(mark: Mark) -> list[Trace]:
    raise TypeError(f"no drawing for {type(mark).__name__}")


@_traces.register(DataSeries)
def _(mark: DataSeries) -> list[Trace]:
    mode = "+".join(["lines"] * (mark.width > 0) + ["markers"] * bool(mark.symbol)) or "none"
    trace: Trace = {
        "type": "scatter", **_axis_values(mark.x), "y": _escape_names(mark.y), "mode": mode,
        "line": {"color": mark.colour}, "opacity": mark.opacity, "legendrank": mark.rank,
        "cliponaxis": mark.clipped, **_hover(mark),
    }  # fmt: skip
    if mark.width:
        trace["line"] = {"color": mark.colour, "width": mark.width, "dash": mark.dash, "shape": STEPS[mark.step]}
    if mark.symbol:
        edge = {"color": mark.edge, "width": 2} if mark.edge else {}
        symbol = SYMBOLS.get(mark.symbol, mark.symbol)
        trace["marker"] = {"symbol": symbol, "size": mark.size, "color": mark.colour, "line": edge}
    if mark.filled:
        trace |= {"fill": "tozeroy", "fillcolor": _tint(mark.colour)}
    if len(mark.low):
        trace["error_x"] = _interval(mark.x, mark.low, mark.high, mark.colour)
    return [trace]


@_traces.register(Range)
def _(mark: Range) -> list[Trace]:
    line = {"color": _tint(mark.colour), "width": 0.5}
    shared: Trace = {"type": "scatter", **_axis_values(mark.x), "mode": "lines", "line": line, **_hover(mark)}
    lower = shared | {"y": mark.low, "showlegend": False}
    return [lower, shared | {"y": mark.high, "fill": "tonexty", "fillcolor": _tint(mark.colour)}]


@_traces.register(Bars)
def _(mark: Bars) -> list[Trace]:
    along, reach = ("y", "x") if mark.horizontal else ("x", "y")
    trace: Trace = {
        "type": "bar", along: _escape_names(mark.positions), reach: mark.values,
        "orientation": "h" if mark.horizontal else "v",
        "marker": {"color": mark.colours[0] if len(set(mark.colours)) == 1 else list(mark.colours)}, **_hover(mark),
    }  # fmt: skip
    if len(mark.low):
        trace[f"error_{reach}"] = _interval(mark.values, mark.low, mark.high, INK)
    if mark.valued:
        trace |= {"texttemplate": f"%{{{reach}:.3~g}}", "textposition": "outside", "cliponaxis": False}
    return [trace]


@_traces.register(Cells)
def _(mark: Cells) -> list[Trace]:
    rounded = [[finite_or_none(value) for value in row] for row in np.asarray(mark.values, dtype=float).tolist()]
    steps = np.linspace(0.0, 1.0, len(mark.scale)).tolist()
    bar: dict[str, object] = {
        "title": {"text": _text(mark.unit), "font": {"size": 12, "color": SOFT}},
        "tickfont": {"size": 11, "color": INK},
        "thickness": 10,
        "outlinecolor": RULE,
        "len": 1.0,
    }
    if mark.ticks:
        bar |= {"tickvals": [at for at, _ in mark.ticks], "ticktext": [text for _, text in mark.ticks]}
    gap = 1 if mark.gap else 0
    trace: Trace = {
        "type": "heatmap", "x": _escape_names(mark.x), "y": _escape_names(mark.y), "z": rounded,
        "colorscale": [[*pair] for pair in zip(steps, mark.scale)], "zmin": mark.ends[0], "zmax": mark.ends[1],
        "xgap": gap, "ygap": gap, "colorbar": bar, "showscale": mark.barred, **_hover(mark),
    }  # fmt: skip
    if mark.written:
        trace |= {"texttemplate": "%{z:.2f}", "textfont": {"size": 9}}
    if mark.shown is not None:
        trace["customdata"] = mark.shown
    return [trace]


@_traces.register(Texts)
def _(mark: Texts) -> list[Trace]:
    return [{
        "type": "scatter", "x": _escape_names(mark.x), "y": _escape_names(mark.y), "mode": "text",
        "text": [f"\u00a0{_text(text)}" for text in mark.texts], "cliponaxis": False, "hoverinfo": "skip",
        "textposition": "top right" if mark.raised else "middle right",
        "textfont": {"size": 12, "color": mark.colour},
    }]  # fmt: skip


def _hover(mark: Mark) -> dict[str, object]:
    """Return the text at a point in plotly's form."""
    if mark.hover is None:
        return {"hoverinfo": "skip"}

    def field(match: re.Match[str]) -> str:
        # Plotly's "g" pads with zeros unless told not to; Python's does not.
        form = f":{match[2]}{'~g' if match[3] else ''}" if match[2] is not None else ""
        return f"%{{{'customdata' if match[1] == 'label' else match[1]}{form}}}"

    template = _FIELD.sub(field, _text(mark.hover))
    options: dict[str, Any] = {"hovertemplate": template}
    if mark.remark is not None:
        options["hovertemplate"] += f"<extra>{_text(mark.remark)}</extra>"
    if mark.labels:
        options["customdata"] = [_text(text) for text in mark.labels]
    return options


def _interval(values: Any, low: Any, high: Any, colour: str) -> dict[str, object]:
    up = [None if h is None or v is None else max(h - v, 0.0) for v, h in zip(values, high, strict=True)]
    down = [None if w is None or v is None else max(v - w, 0.0) for v, w in zip(values, low, strict=True)]
    thin = {"thickness": 1.4, "width": 3.5}
    return {"type": "data", "symmetric": False, "array": up, "arrayminus": down, "color": colour, **thin}


def finite_or_none(value: float) -> float | None:
    """Return the JSON has no NaN; four decimals keep a page small."""
    return round(value, 4) if math.isfinite(value) else None


def _axis_values(x: Positions | Evenly) -> dict[str, object]:
    return {"x0": x.start, "dx": x.step} if isinstance(x, Evenly) else {"x": _escape_names(x)}


def _escape_names(positions: Any) -> Any:
    """Escape the names among axis positions; numeric positions are unchanged."""
    return (
        [_text(at) if isinstance(at, str) else at for at in positions]
        if isinstance(positions, list | tuple)
        else positions
    )


def _text(text: str) -> str:
    """Escape a text for plotly, which reads a subset of HTML; all texts pass through here."""
    return html.escape(printable_lines(text)).replace("\n", "<br>")


def _tint(colour: str) -> str:
    red, green, blue = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.16)"
