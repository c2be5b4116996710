"""Figures of a transfer: predictions and errors before and after (figures 4.8 to 4.11), and all methods by target."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from plotly.subplots import make_subplots

from edp.report.common.drawing import BLUE as DRAWN_BLUE
from edp.report.common.drawing import DROPPED, INK
from edp.report.common.style import BLUE, GREY, MUTED, Control, Plot, styled, with_unit
from edp.report.common.wording import short_label
from edp.report.transfer.facts import SOURCE, TARGET, Transfer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AHEAD, RECORDING = "horizon", "recording"
DOMAINS = {TARGET: "on the target's logs", SOURCE: "on the source's recordings"}


def transfer_plots(facts: Transfer) -> dict[str, Plot]:
    """Every figure by name."""
    plots = [prediction_plot(facts), error_plot(facts), method_plot(facts)]
    return {plot.name: plot for plot in plots}


def _curves(facts: Transfer) -> list[tuple[str, str, str, float]]:
    """Key, name, colour and width of each curve of an excerpt."""
    before, after = facts.pair
    label = {name: html.escape(facts.methods[name]["label"]) for name in facts.pair}
    return [("truth", "Measured", GREY, 3.0), (before, label[before], MUTED[0], 1.4), (after, label[after], BLUE, 1.6)]


def _excerpts(facts: Transfer) -> list[str]:
    return [key.removesuffix("/truth") for key in facts.shown if key.endswith("/truth")]


def _controls(facts: Transfer, *more: Control) -> tuple[Control, ...]:
    options = tuple((horizon, facts.ahead(horizon)) for horizon in facts.horizons)
    return (*more, *((Control(AHEAD, "Horizon", options, False),) if len(options) > 1 else ()))


def prediction_plot(facts: Transfer) -> Plot:
    """Truth, prediction before and after, a row for each target (figures 4.8 and 4.10)."""
    rows = len(facts.targets)
    titles = [with_unit(short_label(facts.name(target)), target["unit"]) for target in facts.targets]
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.18 / rows, subplot_titles=titles)
    names = _excerpts(facts)
    for name in names:
        start = float(facts.shown[f"{name}/start"][0])
        for horizon_index, horizon in enumerate(facts.horizons):
            for key, label, ink, width in _curves(facts):
                values = facts.shown[f"{name}/{key}"][:, horizon_index]
                for row, target in enumerate(facts.targets):
                    figure.add_scatter(
                        x0=start, dx=1 / facts.content["task"]["rate_hz"], row=row + 1, col=1, mode="lines",
                        y=(values[:, row] * target["factor"]).round(3), name=label, legendgroup=key,
                        showlegend=row == 0, line={"color": ink, "width": width}, hovertemplate="%{y:.4~g}",
                        meta={RECORDING: name, AHEAD: horizon},
                        visible=name == names[0] and horizon == facts.horizons[0],
                    )  # fmt: skip
    styled(figure, 90 + 215 * rows, hovermode="x unified")
    figure.update_xaxes(title_text="Time in the test part [s]", row=rows, col=1)
    figure.update_annotations(x=0, xanchor="left")
    figure.update_layout(margin_t=66)
    choice = Control(RECORDING, "Recording", tuple((name, name) for name in names), False)
    return Plot("predictions", figure, _controls(facts, choice))


def error_plot(facts: Transfer) -> Plot:
    """Distribution of the errors before and after, a panel for each target (figures 4.9 and 4.11)."""
    columns = len(facts.targets)
    titles = [html.escape(short_label(facts.name(target))) for target in facts.targets]
    figure = make_subplots(rows=1, cols=columns, horizontal_spacing=0.06, subplot_titles=titles)
    for horizon, by_target in facts.content["distributions"].items():
        for key, label, ink, _ in _curves(facts)[1:]:
            for column, target in enumerate(facts.targets):
                distribution, row = by_target[target["name"]], facts.score(key, horizon, target["name"])
                edges = np.array(distribution["edges"])
                figure.add_scatter(
                    x=((edges[:-1] + edges[1:]) / 2).round(4), y=(100 * np.array(distribution["shares"][key])).round(4),
                    row=1, col=column + 1, name=label, legendgroup=key, showlegend=column == 0, mode="lines",
                    line={"shape": "hvh", "color": ink, "width": 1.6}, fill="tozeroy", opacity=0.7,
                    meta={AHEAD: horizon}, visible=horizon == facts.horizons[0],
                    hovertemplate=f"%{{x:.3~g}}: %{{y:.2f}} %<extra>{label}<br>bias {row['bias']:.3g}, "
                    f"skew {row['skew']:.2f}</extra>",
                )  # fmt: skip
    styled(figure, 340)
    for column, target in enumerate(facts.targets):
        figure.update_xaxes(title_text=with_unit("Error", target["unit"]), row=1, col=column + 1)
    figure.update_yaxes(title_text="Share of samples [%]", row=1, col=1)
    figure.update_yaxes(rangemode="tozero")
    figure.update_layout(margin_t=66)
    return Plot("errors", figure, _controls(facts))


def method_plot(facts: Transfer) -> Plot:
    """MAE of every method by target, in each domain that it was judged in."""
    figure = make_subplots(
        rows=len(facts.domains), cols=1, shared_xaxes=True, vertical_spacing=0.12,
        subplot_titles=[DOMAINS[domain].capitalize() for domain in facts.domains],
    )  # fmt: skip
    for horizon in facts.horizons:
        order = sorted(facts.methods, key=lambda name: facts.score(name, horizon)["mae"])
        labels = [html.escape(facts.methods[name]["label"]) for name in order]
        for row, domain in enumerate(facts.domains, start=1):
            for index, target in enumerate(facts.targets):
                figure.add_bar(
                    x=labels, y=[facts.score(name, horizon, target["name"], domain)["mae"] for name in order],
                    row=row, col=1, name=html.escape(short_label(facts.name(target))), legendgroup=target["name"],
                    showlegend=row == 1, marker={"color": MUTED[index % len(MUTED)]}, meta={AHEAD: horizon},
                    visible=horizon == facts.horizons[0], hovertemplate="%{y:.4~g}",
                )  # fmt: skip
    styled(figure, 120 + 240 * len(facts.domains), bargap=0.3)
    figure.update_yaxes(title_text=with_unit("Mean absolute error", facts.unit))
    figure.update_layout(margin_t=66)
    return Plot("methods", figure, _controls(facts))


def drawings(facts: Transfer) -> dict[str, Callable[[Figure], None]]:
    """What draws each picture, by the name of its file."""
    drawings: dict[str, Callable[[Figure], None]] = {}
    for horizon_index, horizon in enumerate(facts.horizons):
        for name in facts.pair:
            drawings[f"prediction_{name}_k{horizon}"] = partial(
                _draw_course, facts=facts, method=name, horizon_index=horizon_index
            )
            drawings[f"errors_{name}_k{horizon}"] = partial(_draw_errors, facts=facts, method=name, horizon=horizon)
    return drawings


def _draw_course(figure: Figure, facts: Transfer, method: str, horizon_index: int) -> None:
    figure.set_size_inches(8.0, 1.7 * len(facts.targets) + 0.8)
    rows: Any = figure.subplots(nrows=len(facts.targets), sharex=True, squeeze=False)
    name = _excerpts(facts)[0]
    truth, predicted = facts.shown[f"{name}/truth"], facts.shown[f"{name}/{method}"]
    time = facts.shown[f"{name}/start"][0] + np.arange(len(truth)) / facts.content["task"]["rate_hz"]
    for row, target in enumerate(facts.targets):
        axes, factor = rows[row, 0], target["factor"]
        axes.plot(time, truth[:, horizon_index, row] * factor, color=DROPPED, linewidth=2.4, label="measured")
        axes.plot(time, predicted[:, horizon_index, row] * factor, color=DRAWN_BLUE, linewidth=0.9, label="predicted")
        axes.set(ylabel=f"{short_label(facts.name(target))}\n[{target['unit']}]")
    rows[0, 0].legend(frameon=False, fontsize=7, ncols=2)
    rows[-1, 0].set(xlabel="Time in the test part [s]")
    figure.suptitle(f"{facts.methods[method]['label']}, {name}", fontsize=10)


def _draw_errors(figure: Figure, facts: Transfer, method: str, horizon: str) -> None:
    figure.set_size_inches(2.8 * len(facts.targets) + 0.6, 2.8)
    panels: Any = figure.subplots(ncols=len(facts.targets), squeeze=False)
    for column, target in enumerate(facts.targets):
        axes, distribution = panels[0, column], facts.content["distributions"][horizon][target["name"]]
        row = facts.score(method, horizon, target["name"])
        axes.stairs(
            100 * np.array(distribution["shares"][method]),
            distribution["edges"],
            fill=True,
            color=DRAWN_BLUE,
            alpha=0.7,
        )
        axes.axvline(row["bias"], color=INK, linewidth=0.8, linestyle=":")
        axes.set(xlabel=f"Error [{target['unit']}]", title=short_label(facts.name(target)))
        axes.text(0.02, 0.97, f"bias {row['bias']:.2f}\nskew {row['skew']:.2f}", transform=axes.transAxes, va="top")
    panels[0, 0].set(ylabel="Share of samples [%]")
    figure.suptitle(f"{facts.methods[method]['label']}, {facts.ahead(horizon)}", fontsize=10)
