"""The figures of a screening, for its page and its pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from edp.report.common.chart import (
    BLUE,
    DASHES,
    DIVERGING,
    DROPPED,
    FRAME,
    INK,
    LINES,
    SEQUENTIAL,
    Bars,
    Cells,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    GuideLine,
    Mark,
    Panel,
    append_unit,
    finite,
)
from edp.report.screening.views import (
    METRICS,
    UNITS,
    BarView,
    LagView,
    MatrixView,
    importance_views,
    lag_views,
    matrix_views,
    stability_views,
    value_views,
)
from edp.wording import figure, label_by_name

if TYPE_CHECKING:
    from edp.data.screening import ScreeningResult

FIGURES_IN_CELLS = 32
"""Maximum number of channels for which cells show their value."""
LARGE = 60
"""Number of channels above which grid lines and names no longer fit."""


def screening_charts(screening: ScreeningResult) -> list[Chart]:
    """Return the figures for which the screening has data."""
    charts = [
        matrix_chart(matrix_views(screening)),
        lag_chart(lag_views(screening), screening.rate_hz),
        bar_chart("stability", stability_views(screening)),
        bar_chart("importance", importance_views(screening)),
        bar_chart("value", value_views(screening)),
    ]
    return [chart for chart in charts if chart is not None]


def matrix_chart(views: Sequence[MatrixView]) -> Chart | None:
    """Return the matrices of dependence, one at a time."""
    if not views or not views[0].names:
        return None
    names = views[0].names
    count = len(names)
    marks = tuple(
        Cells(
            x=names, y=names, values=view.values, scale=DIVERGING if view.signed else SEQUENTIAL,
            ends=(-view.top if view.signed else 0.0, view.top), unit=view.unit, written=count <= FIGURES_IN_CELLS,
            gap=count <= LARGE, when={"measure": view.measure}, hover="{y} and {x}: {z:.3f}", remark="",
        )
        for view in views
    )  # fmt: skip
    small = count > LARGE
    panel = Panel(
        marks,
        ChartAxis(kind="names", slant=60, grid=False, small=small),
        ChartAxis(kind="names", upside_down=True, grid=False, small=small),
    )
    size = min(max(0.3 * count + 2.0, 5.0), 22.0)
    return Chart(
        "matrices", (panel,), file="matrix_{measure}", title="{measure}", legend="none",
        choices=(Control("measure", "Measure", tuple((view.measure, view.title) for view in views), keeps_zoom=True),),
        height=min(max(22 * count + 200, 420), 1500), inches=(size + 0.6, size),
    )  # fmt: skip


def lag_chart(views: Sequence[LagView], rate_hz: float) -> Chart | None:
    """Return the cross-correlation against the lag, a curve for each of the channels that go best with a target."""
    if not views:
        return None
    marks: list[Mark] = [GuideLine(x=0.0, dash="dot", colour=FRAME)]
    for view in views:
        labels = label_by_name(curve.channel for curve in view.curves)
        for rank, curve in enumerate(view.curves):
            label = f"{labels[curve.channel]} ({curve.best:+d})".replace("-", "−")
            best = f"{curve.channel}, best {curve.best}{'' if curve.certain else ', not certain'}"
            series = DataSeries(
                x=[curve.best], y=[finite(curve.value)], colour=LINES[rank % len(LINES)], name=label,
                when={"target": view.target}, remark=best, hover="lag {x}: {y:.3f}",
            )  # fmt: skip
            marks.append(replace(
                series, x=curve.lags.tolist(), y=np.round(curve.correlation, 4).tolist(),
                width=2.2 if rank == 0 else 1.5, dash=DASHES[rank // len(LINES) % len(DASHES)],
            ))  # fmt: skip
            marks.append(replace(series, symbol="circle" if curve.certain else "x"))
    lags = views[0].curves[0].lags
    across = ChartAxis(
        f"Lag [samples of {figure(1e3 / rate_hz)} ms]; left: the channel leads",
        limits=(float(lags.min()), float(lags.max())),
        grid=True,
    )
    return Chart(
        "lags", (Panel(tuple(marks), across, ChartAxis("Cross-correlation", zero=FRAME)),), file="lags_{target}",
        title="Lags against {target}", choices=(_targets({view.target: 0 for view in views}),),
        height=460, inches=(9.0, 5.0), legend="right",
    )  # fmt: skip


def bar_chart(name: str, views: Sequence[BarView]) -> Chart | None:
    """Return bars with intervals, the largest on top; proposed channels are blue."""
    if not views:
        return None
    marks: list[Mark] = []
    for view in views:
        when = {"metric": view.key, "target": view.target}
        names = [bar.label for bar in view.bars]
        marks.append(Bars(
            positions=names, values=[finite(bar.value) for bar in view.bars], horizontal=True, when=when,
            colours=[BLUE if bar.proposed else DROPPED for bar in view.bars],
            low=[finite(bar.low) for bar in view.bars], high=[finite(bar.high) for bar in view.bars],
            hover="{y}: {x:.3g}", remark="",
        ))  # fmt: skip
        if any(math.isfinite(bar.mark) for bar in view.bars):
            marks.append(DataSeries(
                x=[finite(bar.mark) for bar in view.bars], y=names, symbol="tick", size=10, colour=INK, edge=INK,
                name="chance", when=when, hover="{y}, by chance: {x:.3g}", remark="",
            ))  # fmt: skip
    metrics = dict.fromkeys(view.key for view in views)
    titles = tuple((key, append_unit(METRICS[key], UNITS.get(key, ""))) for key in metrics if key in METRICS)
    panel = Panel(tuple(marks), ChartAxis(grid=True, zero=FRAME), ChartAxis(kind="names", upside_down=True, grid=False))
    metric = (Control("metric", "Metric", titles),) if titles else ()
    most = max(len(view.bars) for view in views)
    return Chart(
        name, (panel,),
        file="stability_{metric}" if titles else name, title="{metric}" if titles else views[0].title,
        choices=(*metric, _targets({view.target: view.more for view in views})), across="target",
        height=90 + 22 * most, inches=(4.6, 1.2 + 0.19 * most),
    )  # fmt: skip


def _targets(more: Mapping[str, int]) -> Control:
    """Return the choice of a target, labelled with its number of hidden channels."""
    names = {**label_by_name(more), **({"all": "mean of all targets"} if "all" in more else {})}
    options = tuple(
        (target, f"{text} (+ {more[target]} more)" if more[target] else text) for target, text in names.items()
    )
    return Control("target", "Target", options)
