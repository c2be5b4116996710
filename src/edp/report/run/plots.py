"""Thin plotly renderers: each takes the plain data of `figures` and returns one figure in the house style."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from edp.report.common.style import (
    BLUE,
    INK,
    Control,
    Plot,
    colour,
    error_title,
    horizon_control,
    line_style,
    name_of,
    styled,
    with_unit,
)
from edp.report.run import figures
from edp.report.run.facts import NETWORK, TRUTH, Facts

DOTS_AT_MOST = 40  # recordings; above that a rank curve, names on hover


def plots_of(facts: Facts) -> dict[str, Plot]:
    """Every figure that the run has data for, by name."""
    makers = (
        prediction_plot,
        residual_plot,
        horizon_plot,
        speed_plot,
        recording_plot,
        learning_plot,
    )
    plots = (maker(facts) for maker in makers)
    return {plot.name: plot for plot in plots if plot is not None}


def prediction_plot(facts: Facts) -> Plot | None:
    """Prediction against truth: one row per output, one shared time axis."""
    lines = figures.prediction_lines(facts)
    if not lines:
        return None
    rows = len(facts.targets)
    recordings = list(dict.fromkeys(line.recording for line in lines))
    horizons = figures.headline_first(facts)
    shown = {"recording": recordings[0], "horizon": str(horizons[0]), "extent": figures.EXCERPT}
    figure = make_subplots(
        rows=rows,
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.18 / max(rows, 2),
        subplot_titles=[with_unit(target.description, target.unit) for target in facts.targets],
    )
    for line in lines:
        meta = {"recording": line.recording, "extent": line.extent}
        if line.horizon is not None:
            meta["horizon"] = str(line.horizon)
        along = {"x": line.x} if line.x is not None else {"x0": line.start, "dx": line.step}
        width = 3.0 if line.model == TRUTH else 1.6 if line.model == NETWORK else 1.1
        figure.add_scatter(
            **along,
            y=line.y,
            row=line.target + 1,
            col=1,
            mode="lines",
            meta=meta,
            name=name_of(facts, line.model),
            legendgroup=line.model,
            showlegend=line.target == 0,
            line={"color": colour(facts, line.model), "width": width},
            opacity=1.0 if line.model == NETWORK else 0.75,
            legendrank={TRUTH: 1, NETWORK: 2}.get(line.model, 3),
            hovertemplate="%{y:.4~g}",
            visible=all(meta.get(key, value) == value for key, value in shown.items()),
        )
    styled(figure, 90 + 215 * rows, hovermode="x unified")
    figure.update_xaxes(title_text="Time [s]" if facts.rate_hz else "Sample", row=rows, col=1)
    figure.update_annotations(x=0, xanchor="left")
    figure.update_layout(margin_t=66)
    longest = max(len(facts.predictions[name][TRUTH]) for name in recordings) / (facts.rate_hz or 1.0)
    stretch = min(len(line.y) * line.step for line in lines if line.extent == figures.EXCERPT and line.horizon is None)
    unit = "s" if facts.rate_hz else "samples"
    extents = (
        (figures.EXCERPT, f"busiest {stretch:.0f} {unit}, every sample"),
        (figures.WHOLE, "whole recording, downsampled"),
    )
    controls = (
        Control("recording", "Recording", tuple((name, name or "recording") for name in recordings), False),
        *horizon_control(facts, horizons),
        Control("extent", "Shown", extents if longest > stretch else extents[:1], False),
    )
    return Plot("predictions", figure, controls)


def residual_plot(facts: Facts) -> Plot | None:
    """Residual histograms: one panel per output."""
    histograms = figures.residual_histograms(facts)
    if not histograms:
        return None
    columns = min(len(facts.targets), 3)
    rows = -(-len(facts.targets) // columns)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        horizontal_spacing=0.06,
        vertical_spacing=0.3 / rows,
        subplot_titles=[html.escape(target.description) for target in facts.targets],
    )
    horizons = figures.headline_first(facts)
    for item in histograms:
        network = item.model == NETWORK
        row, column = divmod(item.target, columns)
        unit = html.escape(facts.targets[item.target].unit)
        figure.add_scatter(
            x=item.centres.astype(np.float32),
            y=(100 * item.share).astype(np.float32),
            row=row + 1,
            col=column + 1,
            name=name_of(facts, item.model),
            legendgroup=item.model,
            showlegend=item.target == 0,
            mode="lines",
            line={"shape": "hvh", "color": colour(facts, item.model), "width": 1.8 if network else 1.2},
            fill="tozeroy" if network else None,
            fillcolor="rgba(11,87,208,0.14)" if network else None,
            meta={"horizon": str(item.horizon)},
            visible=item.horizon == horizons[0],
            hovertemplate=f"%{{x:.3~g}} {unit}: %{{y:.2f}} %<extra>%{{fullData.name}}<br>mean {item.mean:.3g}, "
            f"deviation {item.deviation:.3g} {unit}<br>{100 * item.outside:.1f} % beyond the axis</extra>",
        )
    styled(figure, 60 + 260 * rows)
    for output, target in enumerate(facts.targets):
        row, column = divmod(output, columns)
        figure.update_xaxes(title_text=with_unit("Residual", target.unit), row=row + 1, col=column + 1)
        if column == 0:
            figure.update_yaxes(title_text="Share of samples [%]", row=row + 1, col=1)
    figure.update_yaxes(rangemode="tozero")
    figure.update_layout(margin_t=66)
    return Plot("residuals", figure, horizon_control(facts, horizons, keeps_zoom=False))


def horizon_plot(facts: Facts) -> Plot | None:
    """Error against horizon; with one horizon, a bar per model."""
    curves = figures.horizon_curves(facts)
    if not curves:
        return None
    figure = go.Figure()
    if max(len(curve) for curve in curves.values()) == 1:
        order = sorted(curves, key=lambda name: -curves[name][0][1])
        figure.add_bar(
            x=[curves[name][0][1] for name in order],
            y=[name_of(facts, name) for name in order],
            orientation="h",
            marker={"color": [colour(facts, name) for name in order]},
            width=0.62,
            texttemplate="%{x:.3~g}",
            textposition="outside",
            cliponaxis=False,
            hoverinfo="skip",
        )
        styled(figure, 90 + 34 * len(order), showlegend=False)
        figure.update_layout(margin={"t": 10, "r": 60})
        figure.update_xaxes(title_text=error_title(facts), rangemode="tozero")
        return Plot("horizon", figure)
    for name in sorted(curves, key=lambda name: name == NETWORK):
        x, y = zip(*curves[name], strict=True)
        figure.add_scatter(x=x, y=y, **line_style(facts, name))
    styled(figure, 340, hovermode="x unified")
    figure.update_xaxes(title_text="Horizon [ms]" if facts.rate_hz else "Horizon [samples]", rangemode="tozero")
    figure.update_yaxes(title_text=error_title(facts), rangemode="tozero")
    return Plot("horizon", figure)


def speed_plot(facts: Facts) -> Plot | None:
    """Error by speed band, over the share of samples in each band."""
    horizons = [k for k in figures.headline_first(facts) if figures.speed_bands(facts, k)]
    if not horizons:
        return None
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, row_heights=[0.76, 0.24], vertical_spacing=0.06)
    for horizon in horizons:
        bands = figures.speed_bands(facts, horizon)
        common: dict[str, Any] = {"meta": {"horizon": str(horizon)}, "visible": horizon == horizons[0]}
        for name in sorted(bands, key=lambda name: name == NETWORK):
            labels = [f"{row['low']:g}–{row['high']:g}" for row in bands[name]]
            maes = [row["mae"] for row in bands[name]]
            figure.add_scatter(x=labels, y=maes, row=1, col=1, **line_style(facts, name), **common)
        rows = next(iter(bands.values()))
        total = sum(row["count"] or 0 for row in rows) or 1
        figure.add_bar(
            x=[f"{row['low']:g}–{row['high']:g}" for row in rows],
            y=[100 * (row["count"] or 0) / total for row in rows],
            row=2,
            col=1,
            marker={"color": "#d3dae1"},
            showlegend=False,
            name="Samples",
            hovertemplate="%{y:.3~g} % of the samples<extra></extra>",
            **common,
        )
    styled(figure, 400, bargap=0.25, hovermode="x")
    figure.update_yaxes(title_text=error_title(facts), rangemode="tozero", row=1, col=1)
    figure.update_yaxes(title_text="Samples [%]", nticks=3, row=2, col=1)
    figure.update_xaxes(type="category", title_text=with_unit("Speed band", facts.unit), row=2, col=1)
    figure.update_xaxes(type="category", showticklabels=False, ticks="", row=1, col=1)
    return Plot("speed", figure, horizon_control(facts, horizons, keeps_zoom=False))


def recording_plot(facts: Facts) -> Plot | None:
    """Error by recording: dots in rows, or with many recordings a curve over their rank."""
    horizons = [k for k in figures.headline_first(facts) if figures.recording_errors(facts, k)[0]]
    if not horizons:
        return None
    figure = go.Figure()
    first, _ = figures.recording_errors(facts, horizons[0])
    dots = len(first) <= DOTS_AT_MOST
    for horizon in horizons:
        order, errors = figures.recording_errors(facts, horizon)
        names = [html.escape(name) for name in order]
        ranks = list(range(1, len(order) + 1))
        for name in sorted(errors, key=lambda name: name == NETWORK):
            style = line_style(facts, name) | {"mode": "markers" if dots or name != NETWORK else "lines"}
            style["hovertemplate"] = "%{customdata}: %{" + ("x" if dots else "y") + ":.4~g}"
            style["marker"] |= {"color": colour(facts, name), "size": (11 if name == NETWORK else 8) if dots else 5}
            along = {"x": errors[name], "y": names} if dots else {"x": ranks, "y": errors[name]}
            meta = {"horizon": str(horizon)}
            figure.add_scatter(**along, customdata=names, meta=meta, visible=horizon == horizons[0], **style)
    if dots:
        styled(figure, 110 + 24 * len(first))
        escaped = [html.escape(name) for name in first]
        figure.update_yaxes(type="category", categoryorder="array", categoryarray=escaped[::-1], showgrid=True)
        figure.update_xaxes(title_text=error_title(facts), rangemode="tozero", showgrid=True)
    else:
        styled(figure, 360)
        figure.update_xaxes(title_text="Recordings, sorted by the network's error")
        figure.update_yaxes(title_text=error_title(facts), rangemode="tozero")
    return Plot("recordings", figure, horizon_control(facts, horizons, keeps_zoom=False))


def learning_plot(facts: Facts) -> Plot | None:
    """Loss and validation error by epoch; a dotted line at the epoch whose weights were kept."""
    curves = figures.learning_curves(facts)
    if not curves["epoch"]:
        return None
    figure = make_subplots(
        rows=1, cols=2, horizontal_spacing=0.1, subplot_titles=["Loss", with_unit("Validation error", facts.unit)]
    )
    mode = "lines+markers" if len(curves["epoch"]) < 30 else "lines"
    series = (
        ("train_loss", "Training loss", "#8b929a", 1),
        ("validation_loss", "Validation loss", BLUE, 1),
        ("validation_mae", "Validation error", BLUE, 2),
    )
    for key, name, shade, column in series:
        figure.add_scatter(
            x=curves["epoch"],
            y=curves[key],
            row=1,
            col=column,
            name=name,
            mode=mode,
            showlegend=column == 1,
            line={"color": shade, "width": 2},
            marker={"size": 5},
            customdata=curves["learning_rate"],
            hovertemplate="%{y:.4~g} (learning rate %{customdata:.2~g})",
        )
    styled(figure, 340, hovermode="x unified")
    if curves["best"]:
        figure.add_vline(x=curves["best"][0], line={"color": INK, "width": 1, "dash": "dot"}, row=1, col="all")
    ticks = figures.log_ticks([*curves["train_loss"], *curves["validation_loss"]])
    if ticks:
        figure.update_yaxes(type="log", tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks], row=1, col=1)
    figure.update_xaxes(title_text="Epoch")
    figure.update_layout(margin_t=66)
    return Plot("learning", figure)
