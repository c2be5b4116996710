"""Figures of a comparison: errors by horizon, recording and output, learning curves, cost against error."""

from __future__ import annotations

from dataclasses import replace

from edp.report.common.chart import (
    BLUE,
    GREY,
    MUTED,
    ROUND_TICKS,
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
)  # fmt: skip
from edp.report.compare.paired import Comparison
from edp.report.compare.runs import FREE, ComparedRun
from edp.report.run.figures import log_ticks
from edp.wording import figure, short_labels

MAX_ROWS = 40
"""Maximum number of recordings with their own row of dots."""


def compare_charts(comparison: Comparison) -> list[Chart]:
    """Return the charts for which data are present."""
    makers = (change_chart, horizon_chart, recording_chart, learning_chart, cost_chart)
    return [chart for chart in (maker(comparison) for maker in makers) if chart is not None]


def _all_series(comparison: Comparison) -> list[DataSeries]:
    """Return the series of each run without points; the first run, the reference, is dark grey."""
    names = short_labels(run.name for run in comparison.runs)
    colours = (GREY, BLUE, *MUTED)
    symbols: tuple[Symbol, ...] = ("circle", *SYMBOLS)
    return [
        DataSeries(
            x=(),
            y=(),
            name=name,
            colour=colours[position % len(colours)],
            symbol=symbols[position % len(symbols)],
            rank=position,
        )
        for position, name in enumerate(names)
    ]


def change_chart(comparison: Comparison) -> Chart | None:
    """Change against the first run with its interval, a row an error and run."""
    marks: list[Mark] = []
    rows = [measure.text() for measure in comparison.measures]
    marks.append(DataSeries(x=[0.0] * len(rows), y=rows, hover=None))
    by_measure = [comparison.differences(measure) for measure in comparison.measures]
    for run, series in list(zip(comparison.runs, _all_series(comparison), strict=True))[1:]:
        own = [differences[run.name] for differences in by_measure]
        marks.append(replace(
            series, x=[100 * d.change for d in own], y=rows,
            low=[100 * (d.change if d.low is None else d.low) for d in own],
            high=[100 * (d.change if d.high is None else d.high) for d in own], size=8, hover="{label}",
            labels=[d.text() for d in own],
        ))  # fmt: skip
    marks.append(GuideLine(x=0.0))
    across = ChartAxis(f"Error against {short_labels([comparison.runs[0].name])[0]} [%]", grid=True)
    panel = Panel(tuple(marks), across, ChartAxis(kind="names", upside_down=True, grid=True))
    return Chart("change", (panel,), height=110 + 30 * len(rows))


def horizon_chart(comparison: Comparison) -> Chart | None:
    """Return the error against the time ahead, an output at a time; of twins on the recordings of each run."""
    outputs = list(dict.fromkeys(measure.output for measure in comparison.measures))
    marks: list[Mark] = []
    shown: list[str] = []
    free = comparison.runs[0].kind == FREE
    if free:
        # Curves are over all recordings of a run; they lie beside each other only where these are the same.
        if any(run.recordings != set(comparison.recordings) for run in comparison.runs):
            return None
        outputs = [name for name in comparison.runs[0].curves if all(name in run.curves for run in comparison.runs)]
    for output in outputs:
        curves = [_curve(comparison, run, output) for run in comparison.runs]
        if min(len(x) for x, _ in curves) < 2:
            continue
        shown.append(output)
        for (x, y), series in zip(curves, _all_series(comparison), strict=True):
            line = replace(series, symbol="", size=0) if free else series
            marks.append(replace(line, x=x, y=y, width=2.0, when={"output": output}))
    if not shown:
        return None
    unit = next(m.unit for m in comparison.measures)
    across = ChartAxis("After the start [s]" if free else "Ahead [ms]", kind="log" if free else "linear")
    up = ChartAxis("Stroke error" if free else append_unit("Mean absolute error", unit), from_zero=True)
    choice = Control("output", "Output", tuple((output, output) for output in shown))
    return Chart("horizon", (Panel(tuple(marks), across, up),), choices=(choice,), height=360, together=True)


def _curve(comparison: Comparison, run: ComparedRun, output: str) -> tuple[list[float], list[float | None]]:
    if run.kind == FREE:
        seconds, errors = run.curves[output]
        return list(seconds), list(errors)
    measures = sorted(m for m in comparison.measures if m.output == output)
    return [1000 * m.ahead_s for m in measures], [comparison.error(run, m) for m in measures]


def recording_chart(comparison: Comparison) -> Chart | None:
    """Return the error on each common recording, one row per recording, sorted by the error of the first run."""
    measures = comparison.measures[:6]
    marks: list[Mark] = []
    base = comparison.errors(comparison.runs[0], measures[0])
    order = [comparison.recordings[i] for i in base.argsort()][-MAX_ROWS:]
    labels = dict(zip(order, short_labels(order), strict=True))
    for position, measure in enumerate(measures):
        when = {"measure": str(position)}
        marks.append(DataSeries(x=[None] * len(order), y=list(labels.values()), when=when, hover=None))
        for run, series in zip(comparison.runs, _all_series(comparison), strict=True):
            series = replace(series, size=9, when=when, labels=order, hover="{label}: {x:.4g}")
            errors = [run.errors[measure].get(name) for name in order]
            marks.append(replace(series, x=errors, y=list(labels.values())))
    across = ChartAxis(append_unit("Error", comparison.measures[0].unit), from_zero=True, grid=True)
    panel = Panel(tuple(marks), across, ChartAxis(kind="names", upside_down=True, grid=True))
    choice = Control("measure", "Error", tuple((str(i), measure.text()) for i, measure in enumerate(measures)))
    return Chart("recordings", (panel,), choices=(choice,), height=110 + 24 * len(order))


def learning_chart(comparison: Comparison) -> Chart | None:
    """Return the validation error of each run against epochs, or against training time."""
    marks: list[Mark] = []
    values: list[float | None] = []
    for run, series in zip(comparison.runs, _all_series(comparison), strict=True):
        errors = [row.validation if row.validation_mae is None else row.validation_mae for row in run.history]
        for way, ends in (
            ("epoch", [row.epoch for row in run.history]),
            ("seconds", [row.seconds for row in run.history]),
        ):
            spots = [row.update if end is None else end for row, end in zip(run.history, ends, strict=True)]
            pairs = [(x, y) for x, y in zip(spots, errors, strict=True) if x is not None and y is not None]
            if pairs:
                x, y = zip(*pairs, strict=True)
                values += y
                marks.append(replace(series, x=x, y=y, width=1.8, size=5, when={"way": way}))
    if not marks:
        return None
    free = comparison.runs[0].kind == FREE
    ways = (("epoch", "updates" if free else "epochs"), ("seconds", "seconds of training"))
    ticks = log_ticks(values)
    up = ChartAxis(
        "Validation loss" if free else "Validation error",
        kind="log" if ticks else "linear",
        ticks=tuple((tick, figure(tick)) for tick in ticks),
    )
    across = ChartAxis("Epochs, or seconds")
    return Chart("learning", (Panel(tuple(marks), across, up),), choices=(Control("way", "Against", ways),), height=340)


def cost_chart(comparison: Comparison) -> Chart | None:
    """Return the error against size and work, an error and a cost at a time."""
    costs = [cost for cost in comparison.runs[0].costs if all(cost in run.costs for run in comparison.runs)]
    if not costs:
        return None
    measure = comparison.measures[0]
    marks: list[Mark] = []
    for run, series in zip(comparison.runs, _all_series(comparison), strict=True):
        for position, cost in enumerate(costs):
            at, error, when = [run.costs[cost]], [comparison.error(run, measure)], {"cost": str(position)}
            marks.append(replace(series, x=at, y=error, size=11, when=when, hover="{y:.4g} with {x:,}"))
            marks.append(Texts(x=at, y=error, texts=[series.name], raised=True, when=when))
    choice = Control("cost", "Cost", tuple((str(position), cost) for position, cost in enumerate(costs)), alone=True)
    across = ChartAxis("Cost", kind="log", ticks=ROUND_TICKS)
    up = ChartAxis(append_unit("Error", measure.unit), from_zero=True)
    return Chart("cost", (Panel(tuple(marks), across, up),), choices=(choice,), height=360, legend="none")
