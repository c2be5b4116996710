"""Figures of the page of a twin: free runs with their intervals, and the error over the horizon."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from edp.report.common.style import BLUE, GREY, MUTED, Control, Plot, styled, with_unit
from edp.report.common.wording import short_label
from edp.report.twin.facts import PARTS, TWIN, FreeRunFacts

RECORDING, MODEL = "recording", "model"
BAND = "rgba(11,87,208,0.16)"
DIGITS = 4
"""Significant digits of drawn values: more than a picture shows, a third of the bytes."""


def twin_plots(facts: FreeRunFacts) -> dict[str, Plot]:
    """Every figure by name: ``runs_velocities`` and so on, and ``horizon``."""
    plots = [runs_plot(facts, part) for part in PARTS if facts.channels(part) and facts.names]
    return {plot.name: plot for plot in [*plots, horizon_plot(facts)]}


def runs_plot(facts: FreeRunFacts, part: str) -> Plot:
    """What was measured and what the twin answered meanwhile, with its interval; a row for each channel of a part."""
    channels, columns = facts.channels(part), facts.columns(part)
    titles = [with_unit(short_label(channel["name"]), channel["unit"]) for channel in channels]
    rows, seconds = len(channels), facts.shown["seconds"]
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.18 / rows, subplot_titles=titles)
    half = facts.shown.get("half_width")
    # Shown runs are thinned out evenly, so a start and a step are all that a line needs.
    start, step = float(seconds[0]), float((seconds[-1] - seconds[0]) / (len(seconds) - 1))
    for name in facts.names:
        answers, truth = facts.shown[f"{name}/answers"], facts.shown[f"{name}/truth"]
        for row, (channel, column) in enumerate(zip(channels, columns, strict=True)):
            lines: list[tuple[str, NDArray[Any], dict[str, Any]]] = []
            if half is not None:
                edge = {"line": {"width": 0}, "showlegend": False, "hoverinfo": "skip", "legendgroup": "interval"}
                fill = {**edge, "fill": "tonexty", "fillcolor": BAND, "showlegend": row == 0}
                lines += [("interval, low", answers[:, column] - half[:, column], edge)]
                lines += [("Interval", answers[:, column] + half[:, column], fill)]
            for label, key, values, ink, width in (
                ("Measured", "truth", truth, GREY, 2.6),
                ("Twin, on commands alone", TWIN, answers, BLUE, 1.4),
            ):
                style = {"line": {"color": ink, "width": width}, "legendgroup": key, "hovertemplate": "%{y:.4~g}"}
                lines.append((label, values[:, column], {**style, "showlegend": row == 0}))
            for label, values, style in lines:
                figure.add_scatter(
                    x0=round(start, 6), dx=round(step, 6), y=_rounded(values * channel["factor"]), name=label,
                    mode="lines", row=row + 1, col=1, meta={RECORDING: name}, visible=name == facts.names[0], **style,
                )  # fmt: skip
    styled(figure, 90 + 190 * rows, hovermode="x unified")
    figure.update_xaxes(title_text="Time since the last measured tick [s]", row=rows, col=1)
    figure.update_annotations(x=0, xanchor="left")
    figure.update_layout(margin_t=66)
    options = tuple((name, name) for name in facts.names)
    controls = (Control(RECORDING, "Recording", options, False),) if len(options) > 1 else ()
    return Plot(f"runs_{part}", figure, controls)


def horizon_plot(facts: FreeRunFacts) -> Plot:
    """Mean absolute error over the horizon, a panel for each kind of channel, and half widths of the intervals."""
    parts = [part for part in PARTS if facts.twin["by_horizon"][part]["by_channel"]]
    titles = [with_unit(part.capitalize(), facts.twin["by_horizon"][part]["unit"] or "") for part in parts]
    figure = make_subplots(rows=1, cols=len(parts), horizontal_spacing=0.07, subplot_titles=titles)
    half, seconds = facts.shown.get("half_width"), facts.shown["seconds"]
    for model, scores in facts.models.items():
        by_horizon = scores["by_horizon"]
        for panel, part in enumerate(parts, start=1):
            for index, (name, values) in enumerate(by_horizon[part]["by_channel"].items()):
                ink = MUTED[index % len(MUTED)]
                shared = {"row": 1, "col": panel, "meta": {MODEL: model}, "visible": model == TWIN, "legendgroup": name}
                label = html.escape(short_label(name))
                figure.add_scatter(
                    x=by_horizon["seconds"], y=_rounded(np.array(values, dtype=np.float64)), name=label,
                    mode="lines", line={"color": ink, "width": 2}, hovertemplate="%{y:.3~g}", **shared,
                )  # fmt: skip
                channels = facts.channels(part)
                if model == TWIN and half is not None and len(channels) == len(by_horizon[part]["by_channel"]):
                    at = np.unique(np.geomspace(1, len(seconds), 60).astype(np.int64)) - 1
                    widths = half[at, facts.columns(part)[index]] * channels[index]["factor"]
                    figure.add_scatter(
                        x=_rounded(seconds[at]), y=_rounded(widths), name=f"{label}, half width of its interval",
                        mode="lines", line={"color": ink, "width": 1.2, "dash": "dot"}, hovertemplate="%{y:.3~g}",
                        showlegend=False, **shared,
                    )  # fmt: skip
    styled(figure, 460)
    figure.update_xaxes(type="log", title_text="Time since the last measured tick [s]")
    figure.update_yaxes(rangemode="tozero")
    figure.update_yaxes(title_text="Mean absolute error", row=1, col=1)
    figure.update_layout(margin_t=110)
    options = tuple((model, "The twin" if model == TWIN else f"Floor: {model}") for model in facts.models)
    return Plot("horizon", figure, (Control(MODEL, "Model", options, False),) if len(options) > 1 else ())


def _rounded(values: NDArray[Any]) -> list[float | None]:
    """Values as JSON takes them; none that is not a number."""
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values]
