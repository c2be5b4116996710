"""Figures of a run; each takes the plain data of `figures` and gives their look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from edp.evaluation.guard import MEASURE_NAME
from edp.evaluation.scores_file import SpeedBin, nearest_to_shown
from edp.report.common.chart import (
    BLUE,
    GREY,
    INK,
    MUTED,
    SHADES,
    SYMBOLS,
    Bars,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Evenly,
    GuideLine,
    Mark,
    Panel,
    Range,
    Symbol,
    append_unit,
)  # fmt: skip
from edp.report.run import figures
from edp.report.run.facts import INPUTS, NETWORK, TRUTH, Facts, horizon_text, label_of, main_horizon
from edp.signals import display_offset
from edp.wording import figure, label_by_name, short_labels

MAX_PANELS, MAX_SERIES = 6, 7
"""Maximum number of panels (one per unit), and of signals per panel. More lines are not distinguishable."""
POINTS = 1500
"""Maximum number of points of a signal."""
DOTS_AT_MOST = 40  # recordings; above that a rank curve, names on hover


def run_charts(facts: Facts) -> list[Chart]:
    """Return the figures for which the run has data."""
    makers = (prediction_chart, residual_chart, horizon_chart, speed_chart, recording_chart, learning_chart)
    return [chart for chart in (maker(facts) for maker in makers) if chart is not None]


def colour(facts: Facts, model: str) -> str:
    """Return the colour of a model: network blue, truth dark grey, each baseline its own muted colour."""
    if model in (NETWORK, TRUTH):
        return BLUE if model == NETWORK else GREY
    # Colours repeat when the baselines outnumber them; marks and names still tell them apart.
    return MUTED[_place(facts, model) % len(MUTED)]


def _place(facts: Facts, model: str) -> int:
    names = [name for name in facts.models if name != NETWORK]
    return names.index(model) if model in names else len(names)


def name_of(facts: Facts, model: str) -> str:
    """Return the name of a model in a legend."""
    if model == TRUTH:
        return "Measured"
    label = label_of(facts, model)
    return label_by_name([*(label_of(facts, one) for one in facts.models), label])[label]


def interval_name(facts: Facts) -> str:
    """Return the name of the plotted interval in a legend."""
    rows = facts.models[NETWORK].intervals.get(str(main_horizon(facts)), ()) if NETWORK in facts.models else ()
    coverages = [row.coverage for row in rows]
    return f"{100 * coverages[nearest_to_shown(coverages)]:.0f} % interval" if coverages else "Interval"


def _series(facts: Facts, model: str) -> DataSeries:
    """Return the series of a model without points, as it looks in the figures of errors."""
    network = model == NETWORK
    return DataSeries(
        x=(),
        y=(),
        name=name_of(facts, model),
        colour=colour(facts, model),
        width=2.6 if network else 1.4,
        # Colour is never the only difference.
        symbol="circle" if network else SYMBOLS[_place(facts, model) % len(SYMBOLS)],
        size=8 if network else 7,
        rank=1 if network else 10 + _place(facts, model),
    )


def _error_axis(facts: Facts, of: str = MEASURE_NAME) -> ChartAxis:
    return ChartAxis(append_unit(of, facts.unit), from_zero=True)


def _horizons(facts: Facts, horizons: Sequence[int], keeps_zoom: bool = False) -> Control:
    return Control(
        "horizon", "Horizon", tuple((str(k), f"{horizon_text(facts, k)} ahead") for k in horizons), keeps_zoom
    )


def _network_last(models: Mapping[str, object]) -> list[str]:
    """Return models in drawing order; the network is on top."""
    return sorted(models, key=lambda name: name == NETWORK)


def prediction_chart(facts: Facts) -> Chart | None:
    """Return the prediction against truth: one row per output, one shared time axis."""
    lines = figures.prediction_lines(facts)
    if not lines:
        return None
    marks: list[list[Mark]] = [[] for _ in facts.targets]
    for line in lines:
        when = {"recording": line.recording, "extent": line.extent}
        when |= {} if line.horizon is None else {"horizon": str(line.horizon)}
        width = 3.0 if line.model == TRUTH else 1.6 if line.model == NETWORK else 1.1
        x = Evenly(line.start, line.step) if line.x is None else line.x
        if line.low is not None and line.high is not None:
            marks[line.target].append(
                Range(x=x, low=line.low, high=line.high, name=interval_name(facts), hover=None, when=when)
            )
        marks[line.target].append(DataSeries(
            x=x, y=line.y, name=name_of(facts, line.model),
            colour=colour(facts, line.model), width=width,
            opacity=1.0 if line.model == NETWORK else 0.75, rank={TRUTH: 1, NETWORK: 2}.get(line.model, 3), when=when,
        ))  # fmt: skip
    time = ChartAxis("Time [s]" if facts.rate_hz else "Sample")
    titles = [append_unit(target.description, target.unit) for target in facts.targets]
    panels = [Panel(tuple(row), time, title=title) for title, row in zip(titles, marks, strict=True)]
    recordings = list(dict.fromkeys(line.recording for line in lines))
    longest = max(len(facts.predictions[name][TRUTH]) for name in recordings) / (facts.rate_hz or 1.0)
    stretch = min(len(line.y) * line.step for line in lines if line.extent == figures.EXCERPT and line.horizon is None)
    unit = "s" if facts.rate_hz else "samples"
    extents = (
        (figures.EXCERPT, f"busiest {stretch:.0f} {unit}, every sample"),
        (figures.WHOLE, "whole recording, downsampled"),
    )
    choices = (
        Control("recording", "Recording", tuple((name, name or "recording") for name in recordings), alone=True),
        _horizons(facts, figures.headline_first(facts), keeps_zoom=True),
        Control("extent", "Shown", extents if longest > stretch else extents[:1], alone=True),
    )
    return Chart("predictions", tuple(panels), choices=choices, height=90 + 215 * len(panels), together=True)


def residual_chart(facts: Facts) -> Chart | None:
    """Return the residual histograms: one panel per output."""
    histograms = figures.residual_histograms(facts)
    if not histograms:
        return None
    columns = min(len(facts.targets), 3)
    marks: list[list[Mark]] = [[] for _ in facts.targets]
    for item in histograms:
        network = item.model == NETWORK
        name, unit = name_of(facts, item.model), facts.targets[item.target].unit
        remark = (
            f"{name}\nmean {item.mean:.3g}, deviation {item.deviation:.3g} {unit}\n"
            f"{100 * item.outside:.1f} % beyond the axis"
        )
        marks[item.target].append(DataSeries(
            x=item.centres.astype(np.float32), y=(100 * item.share).astype(np.float32), name=name, step="middle",
            colour=colour(facts, item.model), width=1.8 if network else 1.2, filled=network, remark=remark,
            when={"horizon": str(item.horizon)}, hover=f"{{x:.3g}} {unit}: {{y:.2f}} %",
        ))  # fmt: skip
    panels = []
    for index, (target, row) in enumerate(zip(facts.targets, marks, strict=True)):
        up = ChartAxis("" if index % columns else "Share of samples [%]", from_zero=True)
        panels.append(Panel(tuple(row), ChartAxis(append_unit("Residual", target.unit)), up, target.description))
    height = 60 + 260 * -(-len(panels) // columns)
    choices = (_horizons(facts, figures.headline_first(facts)),)
    return Chart("residuals", tuple(panels), columns=columns, choices=choices, height=height)


def horizon_chart(facts: Facts) -> Chart | None:
    """Return the error against horizon; with one horizon, a bar per model."""
    curves = figures.horizon_curves(facts)
    if not curves:
        return None
    if max(len(curve) for curve in curves.values()) == 1:
        order = sorted(curves, key=lambda name: -curves[name][0][1])
        bars = Bars(
            positions=[name_of(facts, name) for name in order], values=[curves[name][0][1] for name in order],
            valued=True,
            colours=[colour(facts, name) for name in order], horizontal=True, hover=None,
        )  # fmt: skip
        panel = Panel((bars,), _error_axis(facts), ChartAxis(kind="names", grid=False))
        return Chart("horizon", (panel,), height=90 + 34 * len(order), legend="none")
    marks = []
    for name in _network_last(curves):
        x, y = zip(*curves[name], strict=True)
        marks.append(replace(_series(facts, name), x=x, y=y))
    across = ChartAxis("Horizon [ms]" if facts.rate_hz else "Horizon [samples]", from_zero=True)
    return Chart("horizon", (Panel(tuple(marks), across, _error_axis(facts)),), height=340, together=True)


def _band(row: SpeedBin) -> str:
    return f"{row.low:.3g}–{row.high:.3g}"


def speed_chart(facts: Facts) -> Chart | None:
    """Return error by speed band, above the fraction of samples in each band."""
    horizons = [k for k in figures.headline_first(facts) if figures.speed_bands(facts, k)]
    if not horizons:
        return None
    errors: list[Mark] = []
    counts: list[Mark] = []
    for horizon in horizons:
        bands, when = figures.speed_bands(facts, horizon), {"horizon": str(horizon)}
        for name in _network_last(bands):
            labels = [_band(row) for row in bands[name]]
            maes = [row.mae if row.count else None for row in bands[name]]
            errors.append(replace(_series(facts, name), x=labels, y=maes, when=when))
        rows = next(iter(bands.values()))
        total = sum(row.count for row in rows) or 1
        counts.append(Bars(
            positions=[_band(row) for row in rows], colours=["#d3dae1"] * len(rows), when=when,
            values=[100 * row.count / total for row in rows], hover="{y:.3g} % of the samples", remark="",
        ))  # fmt: skip
    across = ChartAxis(append_unit("Speed band", facts.unit), kind="names")
    panels = (
        Panel(tuple(errors), across, _error_axis(facts, "Mean absolute error")),
        Panel(tuple(counts), across, ChartAxis("Samples [%]")),
    )
    choices = (_horizons(facts, horizons),)
    return Chart("speed", panels, choices=choices, height=400, shares=(0.76, 0.24), together=True)


def recording_chart(facts: Facts) -> Chart | None:
    """Return the error by recording: dots in rows, or with many recordings a curve over their rank."""
    horizons = [k for k in figures.headline_first(facts) if figures.recording_errors(facts, k)[0]]
    if not horizons:
        return None
    first, _ = figures.recording_errors(facts, horizons[0])
    dots = len(first) <= DOTS_AT_MOST
    marks: list[Mark] = []
    for horizon in horizons:
        order, errors = figures.recording_errors(facts, horizon)
        when = {"horizon": str(horizon)}
        # Rows stand in the order of the first mark: the network's largest error at the bottom.
        marks += [DataSeries(x=[0.0] * len(first), y=first, when=when, hover=None)] if dots else []
        for name in _network_last(errors):
            network = name == NETWORK
            series = replace(_series(facts, name), labels=order, when=when)
            if dots:
                series = replace(series, x=errors[name], y=order, hover="{label}: {x:.4g}", size=11 if network else 8)
            else:
                ranks = list(range(1, len(order) + 1))
                series = replace(series, x=ranks, y=errors[name], hover="{label}: {y:.4g}", size=5)
            marks.append(replace(series, symbol="") if network and not dots else replace(series, width=0.0))
    choices = (_horizons(facts, horizons),)
    if dots:
        rows = ChartAxis(kind="names", upside_down=True, grid=True)
        panel = Panel(tuple(marks), replace(_error_axis(facts), grid=True), rows)
        return Chart("recordings", (panel,), choices=choices, height=110 + 24 * len(first))
    panel = Panel(tuple(marks), ChartAxis("Recordings, sorted by the network's error"), _error_axis(facts))
    return Chart("recordings", (panel,), choices=choices, height=360)


def learning_chart(facts: Facts) -> Chart | None:
    """Return loss and validation error by epoch; a dotted line marks the epoch of the selected weights."""
    rows = facts.history
    if not rows:
        return None
    epochs = [number if row.epoch is None else row.epoch for number, row in enumerate(rows, 1)]
    symbol: Symbol = "circle" if len(epochs) < 30 else ""
    rates = ["" if row.learning_rate is None else f" (learning rate {row.learning_rate:.2g})" for row in rows]
    curve = DataSeries(
        x=epochs, y=(), colour=BLUE, width=2, symbol=symbol, size=5, labels=rates, hover="{y:.4g}{label}"
    )
    best = [epoch for epoch, row in zip(epochs, rows, strict=True) if row.best][-1:]
    best_epoch = [GuideLine(x=epoch, colour=INK, dash="dot") for epoch in best]
    train_losses, validation_losses = [row.train_loss for row in rows], [row.validation_loss for row in rows]
    loss = (
        replace(curve, y=train_losses, name="Training loss", colour=MUTED[3]),
        replace(curve, y=validation_losses, name="Validation loss"),
    )
    error = replace(curve, y=[row.validation_mae for row in rows], remark="Validation error")
    ticks = figures.log_ticks([*train_losses, *validation_losses])
    up = ChartAxis(kind="log" if ticks else "linear", ticks=tuple((tick, figure(tick)) for tick in ticks))
    panels = (
        Panel((*best_epoch, *loss), ChartAxis("Epoch"), up, "Loss"),
        Panel((*best_epoch, error), ChartAxis("Epoch"), title=append_unit("Validation error", facts.unit)),
    )
    return Chart("learning", panels, columns=2, height=340)


def signal_chart(facts: Facts) -> Chart | None:
    """Return the inputs of one recording over time, one panel per unit; None without stored inputs."""
    name = signals_of(facts)
    channels = () if facts.scores is None else facts.scores.inputs
    if not name or not channels:
        return None
    values, rate = facts.predictions[name][INPUTS], facts.rate_hz or 1.0
    by_unit: dict[str, list[int]] = {}
    for column, channel in enumerate(channels):
        # Numbers without a unit have no common axis: each stands alone.
        by_unit.setdefault(channel.unit if channel.unit != "1" else f"1 {column}", []).append(column)
    panels, names = [], short_labels(channel.name for channel in channels)
    for columns in list(by_unit.values())[:MAX_PANELS]:
        unit = channels[columns[0]].unit
        marks: list[Mark] = []
        labels = [names[column] for column in columns[:MAX_SERIES]]
        for label, column, colour in zip(labels, columns, (BLUE, *SHADES)):
            y = np.asarray(values[:, column] * channels[column].factor + display_offset(unit), dtype=np.float32)
            selected = figures.downsample(y, POINTS)
            x = (selected / rate).astype(np.float32)
            marks.append(DataSeries(x=x, y=y[selected], name=label, colour=colour, width=1.2))
        more = f", {len(columns) - MAX_SERIES} more not drawn" if len(columns) > MAX_SERIES else ""
        title = labels[0] if unit == "1" else append_unit("", unit).strip() + more
        panels.append(Panel(tuple(marks), ChartAxis("Time [s]" if facts.rate_hz else "Sample"), title=title))
    return Chart("signals", tuple(panels), height=100 + 150 * len(panels), together=True)


def signals_of(facts: Facts) -> str:
    """Return the name of the recording whose signals are plotted; empty without signals."""
    return next((name for name, parts in sorted(facts.predictions.items()) if INPUTS in parts), "")
