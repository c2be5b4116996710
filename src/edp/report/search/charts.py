"""The figures of a study, for its page and its pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from edp.evaluation.study import StudyFile
from edp.report.common.chart import (
    BLUE,
    DROPPED,
    INK,
    MUTED,
    ROUND_TICKS,
    RULE,
    SHADES,
    SOFT,
    SYMBOLS,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    GuideLine,
    Mark,
    Panel,
    Symbol,
    Texts,
    append_unit,
)
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
from edp.table import chance
from edp.wording import decimals_for, number


def study_charts(study: StudyFile) -> list[Chart]:
    """Return the figures for which there are data."""
    views = forests(study)
    charts = [
        variance_chart(arm_views(study), study.unit),
        pareto_chart(point_views(study), study.unit),
        forest_chart("confirmation", [view for view in views if view.key != "screening"]),
        forest_chart("screening", [view for view in views if view.key == "screening"]),
        history_chart(tracks(study), study.unit),
    ]
    return [chart for chart in charts if chart is not None]


def variance_chart(arms: Sequence[ArmView], unit: str) -> Chart | None:
    """Return figure 4.3: every run of every arm; a line joins the seeds of a run, a bar is the arm's mean."""
    if not arms:
        return None
    marks: list[Mark] = []
    for centre, arm in enumerate(arms):
        colour = BLUE if arm.chosen else MUTED[0]
        mean = arm.composite.mean
        marks.append(DataSeries(x=[centre - 0.42, centre + 0.42], y=[mean, mean], width=2, colour=INK, hover=None))
        # Runs stand beside each other in 0.72 of an arm's place, so that arms stay apart.
        x = [centre + 0.72 * ((run + 0.5) / len(arm.scores) - 0.5) for run in range(len(arm.scores))]
        # None breaks the line between two runs.
        seeds_x = [value for spot, seeds in zip(x, arm.scores) for value in (*[spot] * len(seeds), None)]
        seeds_y = [score for seeds in arm.scores for score in (*sorted(seeds), None)]
        series = DataSeries(
            x=seeds_x, y=seeds_y, colour=colour, hover="{y:.4g}", remark=arm.features, group=arm.features
        )
        marks.append(replace(series, width=1, symbol="circle", size=4, opacity=0.6))
        means = [sum(seeds) / len(seeds) for seeds in arm.scores]
        symbol: Symbol = "circle" if arm.chosen else "diamond"
        marks.append(replace(series, x=x, y=means, symbol=symbol, size=8, name=arm.features))
    ticks = tuple((float(index), _arm_text(arm)) for index, arm in enumerate(arms))
    return Chart(
        "variance", (Panel(tuple(marks), ChartAxis(limits=(-0.6, len(arms) - 0.4), ticks=ticks), _score_axis(unit)),),
        file="variance", title="Between runs and seeds", inches=(max(1.5 * len(arms) + 1.2, 5.0), 4.4),
    )  # fmt: skip


def _arm_text(arm: ArmView) -> str:
    """Return the lines under an arm: description and standard deviations."""
    spread = arm.composite
    places = decimals_for([spread.split, spread.seed], 2)
    lines = [f"{arm.backbone} {arm.features}", f"σ split {number(spread.split, places)}"]
    return "\n".join([*lines, *([f"σ seed {number(spread.seed, places)}"] if spread.seed is not None else [])])


def _score_axis(unit: str, limits: tuple[float, float] | None = None) -> ChartAxis:
    return ChartAxis(append_unit("Composite score", unit), limits=limits)


def pareto_chart(points: Sequence[PointView], unit: str) -> Chart | None:
    """Return figure 4.4: score against cost, with the Pareto front."""
    costs = [cost for cost in COSTS if any(cost in point.costs for point in points)]
    if not costs:
        return None
    marks: list[Mark] = []
    groups = list(dict.fromkeys(point.group for point in points))
    for cost in costs:
        when = {"cost": cost}
        best = front(points, cost)
        marks.append(DataSeries(
            x=[p.costs[cost] for p in best], y=[p.score for p in best], name="Pareto front", width=2, step="after",
            when=when, hover=None,
        ))  # fmt: skip
        for index, group in enumerate(groups):
            own = [p for p in points if p.group == group and cost in p.costs]
            for on_front in (False, True):
                some = [p for p in own if (p in best) == on_front]
                marks.append(DataSeries(
                    x=[p.costs[cost] for p in some], y=[p.score for p in some], name=group, when=when,
                    symbol=SYMBOLS[index % len(SYMBOLS)], size=11 if on_front else 7, edge=BLUE if on_front else "",
                    colour=SHADES[index % len(SHADES)], labels=[p.label for p in some],
                    hover="{label}\n{y:.4g} with {x:,.0f}", remark="",
                ))  # fmt: skip
        picked: dict[tuple[float, float], str] = {}
        for p in points:
            if p.picked and cost in p.costs:
                # Two words at one place would cover each other.
                at = (p.costs[cost], p.score)
                picked[at] = f"{picked[at]}, {p.picked}" if at in picked else p.picked
        marks.append(Texts(
            x=[x for x, _ in picked], y=[y for _, y in picked], texts=list(picked.values()), raised=True, when=when
        ))  # fmt: skip
    low, top = min(point.score for point in points), top_of(point.score for point in points) or 1.0
    panel = Panel(
        tuple(marks),
        ChartAxis("Cost of the network", titled_by="cost", kind="log", ticks=ROUND_TICKS, grid=True),
        _score_axis(unit, (low - 0.08 * (top - low), top)),
    )
    choice = Control("cost", "Cost", tuple((cost, COSTS[cost]) for cost in costs), keeps_zoom=True)
    return Chart(
        "pareto", (panel,), file="pareto_{cost}", title="Score against cost", choices=(choice,), height=480,
        inches=(8.6, 5.2),
    )  # fmt: skip


def forest_chart(name: str, views: Sequence[Forest]) -> Chart | None:
    """Return effects of the modules with intervals and p-values."""
    if not views:
        return None
    marks: list[Mark] = []
    beside: list[Mark] = []
    for view in views:
        when = {"phase": view.key}
        names = [effect.module for effect in view.effects]
        # Rows stand in the order of the first mark: the best effect on top, whether it passed or not.
        marks.append(DataSeries(x=[effect.value for effect in view.effects], y=names, when=when, hover=None))
        if view.gate is not None:
            marks.append(DataSeries(
                x=[view.gate] * len(names), y=names, name="asked for at least", width=1.6, dash="dot", colour=SOFT,
                when=when, hover=None,
            ))  # fmt: skip
        for good, word in ((True, "passed"), (False, "not passed")):
            own = [effect for effect in view.effects if effect.good == good]
            marks.append(DataSeries(
                x=[effect.value for effect in own], y=[effect.module for effect in own], name=word, when=when,
                low=[effect.low for effect in own], high=[effect.high for effect in own], size=10,
                colour=BLUE if good else DROPPED, symbol="square" if good else "circle",
                hover="{y}: {x:.3g}", remark=word,
            ))  # fmt: skip
        beside.append(Texts(x=[0.0] * len(names), y=names, texts=[_tests_of(e) for e in view.effects], when=when))
    most = max(len(view.effects) for view in views)
    # The title of a forest ends with its metric where there are several.
    title = f"{views[0].title.removesuffix(views[0].short)}{{phase}}" if views[0].short else views[0].title
    rows = ChartAxis(kind="names", upside_down=True, grid=False)
    shown = Panel(tuple(marks), ChartAxis(views[0].axis, zero=INK, grid=True), rows)
    return Chart(
        name, (shown, Panel(tuple(beside), ChartAxis(limits=(0.0, 1.0), shown=False), replace(rows, shown=False))),
        file="effects_{phase}", title=title, columns=2, shares=(0.7, 0.3),
        choices=(Control("phase", "Metric", tuple((view.key, view.short or view.title) for view in views)),),
        height=150 + 30 * most, inches=(8.6, 1.4 + 0.3 * most),
    )  # fmt: skip


def _tests_of(effect: EffectView) -> str:
    """Return the p-values of an effect as text, and the decision on the module."""
    parts = [f"p {chance(effect.p)}"] if effect.p is not None else []
    parts += [f"adj. {chance(effect.adjusted)}"] if effect.adjusted is not None else []
    return " · ".join([*parts, effect.remark])


def history_chart(views: Sequence[PhaseTrack], unit: str) -> Chart | None:
    """Return the score of every training in order of the search; steps are the best of a phase until now."""
    scores = [score for view in views for score in view.scores]
    top = top_of(scores)
    if top is None:
        return None
    marks: list[Mark] = []
    low = min(score for score in scores if math.isfinite(score))
    edge = top + 0.03 * (top - low)
    for index, view in enumerate(views):
        marks += [GuideLine(x=view.places[0] - 0.5, colour=RULE, width=1.5)] if index else []
        marks.append(DataSeries(
            x=view.places, y=[_inside(score, top) for score in view.scores], name=view.heading, group=view.name,
            symbol="circle", size=6, opacity=0.8, colour=SHADES[index % len(SHADES)], labels=view.labels,
            hover="{label}\n{y:.4g}, training {x}", remark="",
        ))  # fmt: skip
        marks.append(DataSeries(
            x=view.places, y=[_inside(value, top) for value in view.best], group="best", width=2, step="after",
            name="best of the phase so far", hover=None,
        ))  # fmt: skip
    above, pruned, failed = outside(views, top)
    kinds: tuple[tuple[list[tuple[int, str]], Symbol, str], ...] = (
        (above, "triangle", "above the scale"),
        (pruned, "dash", "pruned"),
        (failed, "x", "failed"),
    )
    for outliers, symbol, word in kinds:
        if outliers:
            marks.append(DataSeries(
                x=[training for training, _ in outliers], y=[edge] * len(outliers), name=word, symbol=symbol,
                colour=SOFT,
                edge=SOFT, clipped=False, labels=[text for _, text in outliers], hover="{label}, training {x}",
                remark="",
            ))  # fmt: skip
    panel = Panel(tuple(marks), ChartAxis("Training"), _score_axis(unit, (low - 0.06 * (top - low), edge)))
    return Chart("history", (panel,), file="history", title="Search history", inches=(9.0, 4.8))


def outside(views: Sequence[PhaseTrack], top: float) -> tuple[list[tuple[int, str]], ...]:
    """Return trainings above the scale, pruned ones, and failed ones: number and description."""
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
