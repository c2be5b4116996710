"""The figures of a study's page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import plotly.graph_objects as go

from edp.report.common.sheets import chance
from edp.report.common.style import BLUE, INK, MARKS, MUTED, RULE, SOFT, Control, Plot, styled, with_unit
from edp.report.common.wording import decimals_for, number
from edp.report.search.facts import StudyFacts
from edp.report.search.views import (
    COSTS,
    ArmView,
    EffectView,
    Forest,
    PhaseTrack,
    PointView,
    arm_views,
    forests,
    front,
    point_views,
    top_of,
    tracks,
)

DROPPED = "#b4bcc5"
SHADES = (*MUTED, "#3c4650")
TICKS = [step * 10**power for power in range(1, 10) for step in (1, 2, 5)]


def study_plots(study: StudyFacts) -> dict[str, Plot]:
    """Every figure that there are facts for, by name."""
    plots = [
        variance_plot(arm_views(study), study.unit),
        pareto_plot(point_views(study), study.unit),
        forest_plot("confirmation", [view for view in forests(study) if view.key != "screening"]),
        forest_plot("screening", [view for view in forests(study) if view.key == "screening"]),
        history_plot(tracks(study), study.unit),
    ]
    return {plot.name: plot for plot in plots if plot is not None}


def spread_over(centre: int, count: int) -> list[float]:
    """Horizontal places of the runs of an arm."""
    return [centre + 0.72 * ((run + 0.5) / count - 0.5) for run in range(count)]


def arm_caption(arm: ArmView) -> list[str]:
    """Lines under an arm: what it is and its standard deviations."""
    spread = arm.composite
    places = decimals_for([spread.split, spread.seed], 2)
    sigma = [f"split {number(spread.split, places)}"]
    if spread.seed is not None:
        sigma.append(f"seed {number(spread.seed, places)}")
    return [f"{arm.backbone} {arm.features}", *(f"σ {text}" for text in sigma)]


def variance_plot(arms: Sequence[ArmView], unit: str) -> Plot | None:
    """Fig 4.3: every run of every arm; a line joins the seeds of a run, a bar is the arm's mean."""
    if not arms:
        return None
    figure = go.Figure()
    shown: set[bool] = set()
    for centre, arm in enumerate(arms):
        colour = BLUE if arm.chosen else MUTED[0]
        x = spread_over(centre, len(arm.scores))
        means = [sum(seeds) / len(seeds) for seeds in arm.scores]
        joined_x = [value for spot, seeds in zip(x, arm.scores) for value in (*([spot] * len(seeds)), None)]
        joined_y = [value for seeds in arm.scores for value in (*sorted(seeds), None)]
        common = {"legendgroup": str(arm.chosen), "hovertemplate": f"{html.escape(arm.features)}: %{{y:.4~g}}"}
        figure.add_scatter(
            x=joined_x, y=joined_y, mode="lines+markers", showlegend=False, name="seeds", **common,
            line={"color": colour, "width": 1}, marker={"size": 4, "color": colour, "opacity": 0.55},
        )  # fmt: skip
        figure.add_scatter(
            x=x, y=means, mode="markers", name=html.escape(arm.features), showlegend=arm.chosen not in shown,
            marker={"size": 8, "color": colour, "symbol": "circle" if arm.chosen else "diamond"}, **common,
        )  # fmt: skip
        shown.add(arm.chosen)
        mean = arm.composite.mean
        line = {"color": INK, "width": 2}
        figure.add_shape(type="line", x0=centre - 0.42, x1=centre + 0.42, y0=mean, y1=mean, line=line, layer="below")
    styled(figure, 440)
    figure.update_xaxes(
        tickvals=list(range(len(arms))),
        ticktext=["<br>".join(map(html.escape, arm_caption(arm))) for arm in arms],
        range=[-0.6, len(arms) - 0.4],
        ticks="",
    )
    figure.update_yaxes(title_text=with_unit("Composite score", unit))
    return Plot("variance", figure)


def pareto_plot(points: Sequence[PointView], unit: str) -> Plot | None:
    """Fig 4.4: score against a cost, the front marked."""
    costs = [cost for cost in COSTS if any(cost in point.costs for point in points)]
    if not costs:
        return None
    figure = go.Figure()
    groups = list(dict.fromkeys(point.group for point in points))
    top = top_of(point.score for point in points)
    for cost in costs:
        shared = {"meta": {"cost": cost}, "visible": cost == costs[0]}
        best = front(points, cost)
        figure.add_scatter(
            x=[p.costs[cost] for p in best], y=[p.score for p in best], mode="lines", name="Pareto front",
            line={"color": BLUE, "width": 2, "shape": "hv"}, hoverinfo="skip", **shared,
        )  # fmt: skip
        for index, group in enumerate(groups):
            own = [p for p in points if p.group == group and cost in p.costs]
            figure.add_scatter(
                x=[p.costs[cost] for p in own],
                y=[p.score for p in own],
                mode="markers",
                name=html.escape(group),
                marker={
                    "size": [11 if p in best or p.picked else 7 for p in own],
                    "symbol": MARKS[index % len(MARKS)],
                    "color": SHADES[index % len(SHADES)],
                    "line": {"color": BLUE, "width": [2 if p in best else 0 for p in own]},
                },
                text=[html.escape(f"{p.label}{f' ({p.picked})' if p.picked else ''}") for p in own],
                hovertemplate="%{text}<br>%{y:.4~g} with %{x:,.0f}<extra></extra>",
                **shared,
            )
        picked = [p for p in points if p.picked and cost in p.costs]
        figure.add_scatter(
            x=[p.costs[cost] for p in picked], y=[p.score for p in picked], mode="text",
            text=[f"\u00a0\u00a0{html.escape(p.picked)}" for p in picked], textposition="top right", cliponaxis=False,
            textfont={"size": 11, "color": INK}, showlegend=False, hoverinfo="skip", **shared,
        )  # fmt: skip
    styled(figure, 480)
    figure.update_layout(margin={"t": 64})
    figure.update_xaxes(type="log", title_text="Cost of the network", showgrid=True, tickvals=TICKS,
                        ticktext=[short(tick) for tick in TICKS])  # fmt: skip
    low = min(point.score for point in points)
    pad = 0.08 * ((top or low) - low)
    figure.update_yaxes(title_text=with_unit("Composite score", unit), range=[low - pad, top])
    options = tuple((cost, COSTS[cost]) for cost in costs)
    return Plot("pareto", figure, (Control("cost", "Cost", options, keeps_zoom=True),) if len(options) > 1 else ())


def forest_plot(name: str, views: Sequence[Forest]) -> Plot | None:
    """Effects of the modules with their intervals, beside them the p-values."""
    if not views:
        return None
    figure = go.Figure()
    most = max(len(view.effects) for view in views)
    for i, view in enumerate(views):
        shared = {"meta": {"phase": view.key}, "visible": i == 0}
        names = [html.escape(effect.module) for effect in view.effects]
        # The order of the rows is that of the first trace that is shown.
        figure.add_scatter(
            x=[effect.value for effect in view.effects], y=names, mode="markers", marker={"opacity": 0},
            showlegend=False, hoverinfo="skip", **shared,
        )  # fmt: skip
        for good, word in ((True, "passed"), (False, "not passed")):
            own = [effect for effect in view.effects if effect.good == good]
            colour, symbol = (BLUE, "square") if good else (DROPPED, "circle")
            figure.add_scatter(
                x=[effect.value for effect in own],
                y=[html.escape(effect.module) for effect in own],
                mode="markers",
                name=word,
                marker={"size": 10, "color": colour, "symbol": symbol},
                error_x={
                    "type": "data",
                    "symmetric": False,
                    "array": [_reach(effect.high, effect.value) for effect in own],
                    "arrayminus": [_reach(effect.value, effect.low) for effect in own],
                    "color": BLUE if good else SOFT,
                    "thickness": 1.6,
                    "width": 4,
                },
                hovertemplate=f"%{{y}}: %{{x:.3~g}}<extra>{word}</extra>",
                **shared,
            )
        if view.gate is not None:
            figure.add_scatter(
                x=[view.gate] * len(names), y=names, mode="lines", name="asked for at least",
                line={"color": SOFT, "dash": "dot", "width": 1.2}, hoverinfo="skip", **shared,
            )  # fmt: skip
        figure.add_scatter(
            x=[*([0.0] * len(names)), 1.0], y=[*names, names[-1]], mode="text", textposition="middle right",
            text=[*(html.escape(tests_of(effect)) for effect in view.effects), ""], xaxis="x2", cliponaxis=False,
            textfont={"size": 12, "color": INK}, showlegend=False, hoverinfo="skip", **shared,
        )  # fmt: skip
    styled(figure, 150 + 30 * most)
    figure.update_layout(
        margin={"l": 150, "t": 56}, xaxis={"domain": [0, 0.7]}, xaxis2={"domain": [0.72, 1], "visible": False}
    )
    figure.update_yaxes(type="category", autorange="reversed", showgrid=False)
    title = html.escape(views[0].axis)
    figure.update_layout(xaxis={"title": {"text": title}, "zeroline": True, "zerolinecolor": INK, "showgrid": True})
    options = tuple((view.key, view.short) for view in views)
    return Plot(name, figure, (Control("phase", "Metric", options, keeps_zoom=False),) if len(views) > 1 else ())


def tests_of(effect: EffectView) -> str:
    """The p-values of an effect as text, and what became of the module."""
    parts = [f"p {chance(effect.p)}"] if effect.p is not None else []
    parts += [f"adj. {chance(effect.adjusted)}"] if effect.adjusted is not None else []
    return " · ".join([*parts, effect.remark])


def short(value: int) -> str:
    """A round number as ``20k``."""
    for size, letter in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if value >= size:
            return f"{value // size}{letter}"
    return str(value)


def _reach(high: float | None, low: float | None) -> float | None:
    return None if high is None or low is None else max(high - low, 0.0)


def history_plot(views: Sequence[PhaseTrack], unit: str) -> Plot | None:
    """Score of every training in the order of the search; steps are the best of a phase so far."""
    scores = [score for view in views for score in view.scores]
    top = top_of(scores)
    if top is None:
        return None
    figure = go.Figure()
    low = min(score for score in scores if math.isfinite(score))
    edge = top + 0.03 * (top - low)
    for index, view in enumerate(views):
        colour = SHADES[index % len(SHADES)]
        inside = [score if math.isfinite(score) and score <= top else None for score in view.scores]
        figure.add_scatter(
            x=view.places, y=inside, mode="markers", name=view.heading, legendgroup=view.name,
            marker={"size": 6, "color": colour, "opacity": 0.8}, text=[html.escape(label) for label in view.labels],
            hovertemplate="%{text}<br>%{y:.4~g}<extra>training %{x}</extra>",
        )  # fmt: skip
        figure.add_scatter(
            x=view.places, y=[_inside(value, top) for value in view.best], mode="lines", legendgroup=view.name,
            showlegend=False, line={"color": BLUE, "width": 2, "shape": "hv"}, hoverinfo="skip",
        )  # fmt: skip
        if index:
            figure.add_vline(x=view.places[0] - 0.5, line={"color": RULE, "width": 1.5})
    above, pruned, failed = outside(views, top)
    kinds = ((above, "triangle-up", "above the scale"), (pruned, "line-ew-open", "pruned"), (failed, "x", "failed"))
    for marks, symbol, word in kinds:
        if marks:
            figure.add_scatter(
                x=[number for number, _ in marks], y=[edge] * len(marks), mode="markers", name=word, cliponaxis=False,
                marker={"size": 7, "symbol": symbol, "color": SOFT}, text=[html.escape(text) for _, text in marks],
                hovertemplate="%{text}<extra>training %{x}</extra>",
            )  # fmt: skip
    styled(figure, 440)
    figure.update_layout(margin={"t": 64})
    figure.update_xaxes(title_text="Training", showgrid=False)
    pad = 0.06 * (top - low)
    figure.update_yaxes(title_text=with_unit("Composite score", unit), range=[low - pad, edge])
    return Plot("history", figure)


def outside(views: Sequence[PhaseTrack], top: float) -> tuple[list[tuple[int, str]], ...]:
    """Trainings above the scale, those that were pruned, and those that failed: number and what they were."""
    above, pruned, failed = [], [], []
    for view in views:
        for position, score, label in zip(view.places, view.scores, view.labels):
            if position in view.pruned:
                pruned.append((position, label))
            elif not math.isfinite(score):
                failed.append((position, label))
            elif score > top:
                above.append((position, f"{label}: {score:.4g}"))
    return above, pruned, failed


def _inside(value: float, top: float) -> float | None:
    return value if math.isfinite(value) and value <= top else None
