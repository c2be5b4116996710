"""The figures of a screening's page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from edp.data.screening import ScreeningResult
from edp.report.common.style import BLUE, INK, MUTED, RULE, SOFT, Control, Plot, styled
from edp.report.common.wording import short_label
from edp.report.screening.views import (
    METRICS,
    BarView,
    LagView,
    MatrixView,
    importance_views,
    lag_views,
    matrix_views,
    stability_views,
    value_views,
)

SEQUENTIAL = [[0.0, "#f7fafe"], [0.25, "#b7d0f7"], [0.5, "#6d9fec"], [0.75, "#2567d3"], [1.0, "#062c74"]]
DIVERGING = [
    [0.0, "#7a4a06"], [0.25, "#d79a3c"], [0.5, "#ffffff"], [0.75, "#6d9fec"], [1.0, "#062c74"],
]  # fmt: skip
"""Negative in the muted orange of the house, positive in its blue; equal steps look equally strong."""
LINES = (BLUE, *MUTED, "#3c4650")
DASHES = ("solid", "dash", "dot", "dashdot")
DROPPED = "#b4bcc5"
_CELL, _LEAST, _MOST = 22, 420, 1500
_FIGURES_IN_CELLS = 32


def screening_plots(screening: ScreeningResult) -> dict[str, Plot]:
    """Every figure that the screening has data for, by name."""
    plots = [
        matrix_plot(matrix_views(screening)),
        lag_plot(lag_views(screening), screening.rate_hz),
        bar_plot("stability", stability_views(screening), ("metric", "target")),
        bar_plot("importance", importance_views(screening), ("target",)),
        bar_plot("value", value_views(screening), ("target",)),
    ]
    return {plot.name: plot for plot in plots if plot is not None}


def matrix_plot(views: Sequence[MatrixView]) -> Plot | None:
    """The matrices of dependence, one at a time."""
    if not views or not views[0].names:
        return None
    names = [html.escape(name) for name in views[0].names]
    count = len(names)
    figure = go.Figure()
    for i, view in enumerate(views):
        text = {"texttemplate": "%{z:.2f}", "textfont": {"size": 9}} if count <= _FIGURES_IN_CELLS else {}
        figure.add_heatmap(
            x=names,
            y=names,
            z=[[None if not math.isfinite(v) else round(float(v), 4) for v in row] for row in view.values],
            colorscale=DIVERGING if view.signed else SEQUENTIAL,
            zmin=-view.top if view.signed else 0.0,
            zmax=view.top,
            xgap=1 if count <= 60 else 0,
            ygap=1 if count <= 60 else 0,
            colorbar={
                "title": {"text": view.unit, "font": {"size": 12, "color": SOFT}},
                "tickfont": {"size": 11, "color": INK},
                "thickness": 10,
                "outlinecolor": RULE,
                "len": 1.0,
            },
            meta={"measure": view.measure},
            visible=i == 0,
            hovertemplate="%{y} and %{x}: %{z:.3f}<extra></extra>",
            **text,
        )
    size = min(max(_CELL * count + 150, _LEAST), _MOST)
    styled(figure, size)
    figure.update_layout(margin={"t": 36, "r": 70, "b": 110, "l": 120})
    small = {"tickfont": {"size": 11 if count <= 60 else 8, "color": SOFT}, "dtick": 1, "showgrid": False}
    figure.update_xaxes(tickangle=-60, **small)
    figure.update_yaxes(autorange="reversed", **small)
    options = tuple((view.measure, view.title) for view in views)
    return Plot("matrices", figure, (Control("measure", "Measure", options),))


def lag_plot(views: Sequence[LagView], rate_hz: float) -> Plot | None:
    """Cross-correlation against the lag, a curve for each of the channels that go best with a target."""
    if not views:
        return None
    figure = go.Figure()
    for i, view in enumerate(views):
        for k, curve in enumerate(view.curves):
            unsure = "" if curve.certain else ", not certain"
            figure.add_scatter(
                x=curve.lags.tolist(),
                y=np.round(curve.correlation, 4).tolist(),
                name=f"{html.escape(short_label(curve.channel))} ({curve.best:+d})".replace("-", "−"),
                mode="lines",
                line={
                    "color": LINES[k % len(LINES)],
                    "dash": DASHES[k // len(LINES) % len(DASHES)],
                    "width": 2.2 if k == 0 else 1.5,
                },
                meta={"target": view.target},
                visible=i == 0,
                hovertemplate=f"{html.escape(curve.channel)}, lag %{{x}}: %{{y:.3f}}<extra>best {curve.best}"
                f"{unsure}</extra>",
            )
    styled(figure, 460)
    figure.add_vline(x=0, line={"color": SOFT, "width": 1, "dash": "dot"})
    figure.update_layout(
        legend={"orientation": "v", "x": 1.01, "y": 1, "yref": "paper", "xanchor": "left"}, margin={"r": 190, "t": 36}
    )
    figure.update_xaxes(title_text=f"Lag [samples of {1e3 / rate_hz:g} ms]; left: the channel leads", showgrid=True)
    figure.update_yaxes(title_text="Cross-correlation", zeroline=True, zerolinecolor="#c4cbd2")
    return Plot("lags", figure, _targets([view.target for view in views]))


def bar_plot(name: str, views: Sequence[BarView], keys: Sequence[str]) -> Plot | None:
    """Bars with intervals, the largest on top; what is proposed is blue."""
    if not views:
        return None
    figure = go.Figure()
    most = max(len(view.bars) for view in views)
    for i, view in enumerate(views):
        meta = {"metric": view.key, "target": view.target}
        common: dict[str, Any] = {
            "meta": {key: meta[key] for key in keys},
            "visible": i == 0,
            "y": [html.escape(bar.label) for bar in view.bars],
        }
        figure.add_bar(
            x=[_short(bar.value) for bar in view.bars],
            orientation="h",
            marker={"color": [BLUE if bar.proposed else DROPPED for bar in view.bars]},
            error_x={
                "type": "data",
                "symmetric": False,
                "array": [_short(max(bar.high - bar.value, 0.0)) for bar in view.bars],
                "arrayminus": [_short(max(bar.value - bar.low, 0.0)) for bar in view.bars],
                "color": INK,
                "thickness": 1.2,
                "width": 3,
            },
            name=view.title,
            showlegend=False,
            hovertemplate="%{y}: %{x:.3~g}<extra></extra>",
            **common,
        )
        if any(math.isfinite(bar.mark) for bar in view.bars):
            figure.add_scatter(
                x=[_short(bar.mark) for bar in view.bars],
                mode="markers",
                marker={"symbol": "line-ns-open", "size": 10, "color": INK},
                name="chance",
                showlegend=True,
                hovertemplate="%{y}, by chance: %{x:.3~g}<extra></extra>",
                **common,
            )
    styled(figure, 90 + 22 * most, bargap=0.35)
    figure.update_yaxes(type="category", autorange="reversed", showgrid=False)
    figure.update_xaxes(showgrid=True, zeroline=True, zerolinecolor="#c4cbd2")
    return Plot(name, figure, _controls(views, keys))


def _controls(views: Sequence[BarView], keys: Sequence[str]) -> tuple[Control, ...]:
    controls: tuple[Control, ...] = ()
    if "metric" in keys:
        options = tuple((key, METRICS[key]) for key in dict.fromkeys(view.key for view in views))
        controls += (Control("metric", "Metric", options, keeps_zoom=False),) if len(options) > 1 else ()
    return controls + _targets(list(dict.fromkeys(view.target for view in views)))


def _targets(targets: Sequence[str]) -> tuple[Control, ...]:
    options = tuple((target, "mean of all targets" if target == "all" else target) for target in targets)
    return (Control("target", "Target", options, keeps_zoom=False),) if len(options) > 1 else ()


def _short(value: float) -> float | None:
    """Five digits, so that a page stays small; None where there is no value."""
    return float(f"{value:.5g}") if math.isfinite(value) else None
