"""Figures of a search for a smaller network: the size profile of figures 4.5 and 4.6, and the front."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from edp.report.common.drawing import BLUE as DRAWN_BLUE
from edp.report.common.drawing import DROPPED, INK
from edp.report.common.style import BLUE, GREY, MUTED, RULE, SOFT, Control, Plot, styled, with_unit
from edp.report.compression.facts import COSTS, CompressionFacts
from edp.report.search.plots import TICKS, short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AHEAD, COST = "horizon", "cost"
MOMENTS = (("before", "in float32", "circle-open", GREY), ("scores", "in its format", "circle", BLUE))


def compression_plots(facts: CompressionFacts) -> dict[str, Plot]:
    """Every figure by name."""
    plots = [profile_plot(facts), front_plot(facts)]
    return {plot.name: plot for plot in plots}


def profile_plot(facts: CompressionFacts) -> Plot:
    """Parameters as bars and MAE before and after (left), composite scores with the front marked (right)."""
    figure = make_subplots(cols=2, specs=[[{"secondary_y": True}, {}]], horizontal_spacing=0.12)
    places = facts.smallest()
    rows = [facts.rows[index] for index in places]
    names = [html.escape(row["name"]) for row in rows]
    sizes = [row["resource_usage"]["parameters"] for row in rows]
    bars = {"marker": {"color": RULE}, "name": "parameters", "hovertemplate": "%{y:,}"}
    figure.add_bar(x=names, y=sizes, row=1, col=1, **bars)
    for horizon in facts.horizons:
        shared: dict[str, Any] = {"meta": {AHEAD: horizon}, "visible": horizon == facts.horizons[0]}
        for when, name, symbol, ink in MOMENTS:
            values = [facts.mae(row, horizon, when) for row in rows]
            marker = {"symbol": symbol, "size": 13 if when == "before" else 7, "color": ink}
            figure.add_scatter(
                x=names, y=values, mode="markers", name=f"MAE {name}", row=1, col=1, secondary_y=True, marker=marker,
                hovertemplate="%{y:.4~g}", **shared,
            )  # fmt: skip
        colours = [BLUE if index in facts.content["front"] else MUTED[3] for index in places]
        scores = [row["scores"][horizon]["composite"] for row in rows]
        figure.add_bar(
            x=names, y=scores, row=1, col=2, marker={"color": colours}, showlegend=False, hovertemplate="%{y:.4~g}",
            **shared,
        )  # fmt: skip
    styled(figure, 480)
    unit = facts.content["unit"]
    figure.update_yaxes(type="log", title_text="Parameters", row=1, col=1, secondary_y=False)
    error = with_unit("Mean absolute error", unit)
    figure.update_yaxes(
        type="log",
        title_text=error,
        tickvals=_ticks(facts),
        tickformat=".3~g",
        row=1,
        col=1,
        secondary_y=True,
        showgrid=False,
    )
    figure.update_yaxes(title_text=with_unit("Composite score, the front in blue", unit), row=1, col=2)
    options = tuple((horizon, facts.ahead(horizon)) for horizon in facts.horizons)
    return Plot("profile", figure, (Control(AHEAD, "Horizon", options, False),) if len(options) > 1 else ())


def front_plot(facts: CompressionFacts) -> Plot:
    """Error over that of the teacher against a cost, with the limit of the budget."""
    figure = go.Figure()
    groups = list(dict.fromkeys(row["label"] for row in facts.rows))
    for cost in COSTS:
        shared: dict[str, Any] = {"meta": {COST: cost}, "visible": cost == next(iter(COSTS))}
        line = _front(facts, cost)
        figure.add_scatter(
            x=[point[0] for point in line], y=[point[1] for point in line], mode="lines", name="front",
            line={"color": BLUE, "width": 2, "shape": "hv"}, hoverinfo="skip", **shared,
        )  # fmt: skip
        for position, group in enumerate(groups):
            rows = [row for row in facts.rows if row["label"] == group]
            figure.add_scatter(
                x=[facts.cost(row, cost) for row in rows],
                y=[_percent(row) for row in rows],
                mode="markers",
                name=html.escape(group),
                text=[html.escape(row["name"]) for row in rows],
                marker={"size": 9, "color": MUTED[position % len(MUTED)]},
                hovertemplate="%{text}: %{y:+.2f} %, %{x:,}",
                **shared,
            )
        limit = facts.content["budget"][cost]
        ends = [min(_percent(row) for row in facts.rows), max(_percent(row) for row in facts.rows)]
        figure.add_scatter(
            x=[limit, limit], y=ends, mode="lines", name="budget", line={"color": SOFT, "dash": "dot"},
            hoverinfo="skip", **shared,
        )  # fmt: skip
    styled(figure, 440)
    ticks = {"tickvals": TICKS, "ticktext": [short(tick) for tick in TICKS]}
    figure.update_xaxes(type="log", title_text="Cost", showgrid=True, **ticks)
    figure.update_yaxes(title_text="Error over the teacher's [%]")
    return Plot("front", figure, (Control(COST, "Cost", tuple(COSTS.items()), False),))


def drawings(facts: CompressionFacts) -> dict[str, Callable[[Figure], None]]:
    """What draws each picture, by the name of its file: the size profile of each horizon."""
    return {f"profile_k{horizon}": partial(_draw, facts=facts, horizon=horizon) for horizon in facts.horizons}


def _draw(figure: Figure, facts: CompressionFacts, horizon: str) -> None:
    shown = facts.smallest()
    rows = [facts.rows[index] for index in shown]
    figure.set_size_inches(max(8.0, 0.5 * len(rows) + 4), 4.2)
    left, right = figure.subplots(ncols=2)
    places = range(len(rows))
    left.bar(places, [row["resource_usage"]["parameters"] for row in rows], color=RULE)
    left.set(yscale="log", ylabel="Parameters (bars)")
    errors = left.twinx()
    for when, text, size in (("before", "MAE in float32", 60), ("scores", "MAE in its format", 16)):
        values = [facts.mae(row, horizon, when) for row in rows]
        fill = "none" if when == "before" else DRAWN_BLUE
        edge = INK if when == "before" else DRAWN_BLUE
        errors.scatter(places, values, s=size, facecolors=fill, edgecolors=edge, label=text, zorder=3)
    errors.set(yscale="log", ylabel=f"MAE [{facts.content['unit']}]")
    errors.legend(frameon=False, fontsize=7)
    for axes in (left, errors):
        axes.yaxis.set_major_formatter(_plainly)
        axes.yaxis.set_minor_formatter(_plainly if axes is errors else "")
    colours = [DRAWN_BLUE if index in facts.content["front"] else DROPPED for index in shown]
    right.bar(places, [row["scores"][horizon]["composite"] for row in rows], color=colours)
    right.set(ylabel=f"Composite score [{facts.content['unit']}], the front in blue")
    for axes in (left, right):
        axes.set_xticks(list(places), [row["name"] for row in rows], rotation=90, fontsize=7)
    figure.suptitle(facts.ahead(horizon), fontsize=10)


def _ticks(facts: CompressionFacts) -> list[float]:
    """Five round errors for each horizon, evenly spread on a logarithmic axis."""
    ticks = set()
    for horizon in facts.horizons:
        values = [facts.mae(row, horizon) for row in facts.rows]
        low, high = min(values), max(values)
        # A perfect error of zero has no place on a logarithmic axis.
        ticks |= {float(f"{low * (high / low) ** (step / 4):.2g}") for step in range(5)} if low > 0 else set()
    return sorted(ticks)


def _plainly(value: float, position: int | None) -> str:
    return f"{value:,.4g}" if value < 1e4 else f"{value / 1e3:,.4g} k"


def _percent(row: Any) -> float:
    return 100 * (float(row["error"]) - 1)


def _front(facts: CompressionFacts, cost: str) -> list[tuple[float, float]]:
    """Points that no other one betters in error at no greater cost."""
    line: list[tuple[float, float]] = []
    for x, y in sorted((facts.cost(row, cost), _percent(row)) for row in facts.rows):
        if not line or y < line[-1][1]:
            line.append((x, y))
    return line
