"""Figures of a transfer: predictions and errors before and after (figures 4.8 to 4.11), and all methods by target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edp.evaluation.scores_file import ScoredTarget, metric
from edp.evaluation.transfer_file import SOURCE, TARGET
from edp.report.common.chart import (
    BLUE,
    GREY,
    MUTED,
    Bars,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Evenly,
    Mark,
    Panel,
    Texts,
    append_unit,
)  # fmt: skip
from edp.report.transfer.facts import Transfer
from edp.signals import display_offset
from edp.wording import label_by_name

AHEAD, RECORDING = "horizon", "recording"
DOMAINS = {TARGET: "On the target's logs", SOURCE: "On the source's recordings"}


def picture_charts(facts: Transfer) -> list[Chart]:
    """Return the thesis's figures before and after fine-tuning, and the predictions of the first recording."""
    charts = []
    for method in facts.pair:
        label = facts.methods[method].label
        course = prediction_chart(facts, (method,))
        name = course.choices[0].options[0][0]
        panels = tuple(panel.select({RECORDING: name}) for panel in course.panels)
        course = replace(course, panels=panels, choices=course.choices[1:], title=f"{label}, {name}, {{horizon}}")
        charts += [replace(course, file=f"prediction_{method}_k{{horizon}}"), error_chart(facts, (method,))]
        charts[-1] = replace(charts[-1], title=f"{label}, {{horizon}}", file=f"errors_{method}_k{{horizon}}")
    return charts


def _look(facts: Transfer, method: str) -> tuple[str, str, float]:
    """Name, colour and width of a method's curve."""
    label = facts.methods[method].label
    return (label, BLUE, 1.6) if method == facts.content.method else (label, MUTED[0], 1.4)


def _horizons(facts: Transfer) -> Control:
    return Control(AHEAD, "Horizon", tuple((horizon, facts.ahead(horizon)) for horizon in facts.horizons))


def _label(facts: Transfer, target: ScoredTarget) -> str:
    return label_by_name(facts.name(one) for one in facts.targets)[facts.name(target)]


def prediction_chart(facts: Transfer, methods: Sequence[str]) -> Chart:
    """Return the measured and predicted, a row for each target (figures 4.8 and 4.10)."""
    names = [key.removesuffix("/truth") for key in facts.shown if key.endswith("/truth")]
    curves = [("truth", ("Measured", GREY, 3.0)), *((method, _look(facts, method)) for method in methods)]
    panels = []
    for column, target in enumerate(facts.targets):
        marks: list[Mark] = []
        for name in names:
            time_s = Evenly(float(facts.shown[f"{name}/start"][0]), 1 / facts.content.task.rate_hz)
            for order, horizon in enumerate(facts.horizons):
                for key, (label, colour, width) in curves:
                    values = facts.shown[f"{name}/{key}"][:, order, column] * target.factor
                    values = (values + display_offset(target.unit)).round(3)
                    when = {RECORDING: name, AHEAD: horizon}
                    marks.append(DataSeries(x=time_s, y=values, name=label, colour=colour, width=width, when=when))
        title = append_unit(_label(facts, target), target.unit)
        panels.append(Panel(tuple(marks), ChartAxis("Time in the test part [s]"), title=title))
    choice = Control(RECORDING, "Recording", tuple((name, name) for name in names), alone=True)
    return Chart(
        "predictions", tuple(panels), choices=(choice, _horizons(facts)), height=90 + 215 * len(panels),
        inches=(8.0, 1.9 * len(panels) + 0.8), together=True,
    )  # fmt: skip


def error_chart(facts: Transfer, methods: Sequence[str]) -> Chart:
    """Return distribution of the errors, a panel for each target (figures 4.9 and 4.11); a dotted line is the bias."""
    panels: list[Panel] = []
    for target in facts.targets:
        marks: list[Mark] = []
        for horizon, by_target in facts.content.distributions.items():
            distribution, when = by_target[target.name], {AHEAD: horizon}
            edges = np.array(distribution.edges)
            for method in methods:
                scores, (label, colour, width) = facts.score(method, horizon, target.name), _look(facts, method)
                shares = (100 * np.array(distribution.shares[method])).round(4)
                bias, skew = metric(scores, "bias"), metric(scores, "skew")
                remark = f"{label}, bias {bias:.3g}, skew {skew:.2f}"
                marks.append(DataSeries(
                    x=((edges[:-1] + edges[1:]) / 2).round(4), y=shares, name=label, colour=colour, width=width,
                    step="middle", filled=True, when=when, hover="{x:.3g}: {y:.2f} %", remark=remark,
                ))  # fmt: skip
                marks.append(DataSeries(
                    x=[bias] * 2, y=[0.0, float(shares.max())], colour=colour, width=1.2, dash="dot",
                    group=label, when=when, hover=None,
                ))  # fmt: skip
                if len(methods) == 1:
                    words = f"bias {bias:.2f}\nskew {skew:.2f}"
                    marks.append(Texts(x=[edges[0]], y=[0.92 * shares.max()], texts=[words], when=when))
        across = ChartAxis(append_unit("Error", target.unit))
        up = ChartAxis("" if panels else "Share of samples [%]", from_zero=True)
        panels.append(Panel(tuple(marks), across, up, _label(facts, target)))
    return Chart(
        "errors", tuple(panels), columns=len(panels), choices=(_horizons(facts),), height=340,
        inches=(2.8 * len(panels) + 0.6, 3.0),
    )  # fmt: skip


def method_chart(facts: Transfer) -> Chart:
    """Return the MAE of every method by target, in each evaluated domain."""
    panels = []
    for domain in facts.domains:
        marks: list[Mark] = []
        for horizon in facts.horizons:
            order = sorted(facts.methods, key=lambda name: facts.mae(name, horizon))
            labels = [facts.methods[name].label for name in order]
            for index, target in enumerate(facts.targets):
                values = [facts.mae(name, horizon, target.name, domain) for name in order]
                marks.append(Bars(
                    positions=labels, values=values, colours=[MUTED[index % len(MUTED)]] * len(values),
                    name=_label(facts, target), when={AHEAD: horizon},
                ))  # fmt: skip
        up = ChartAxis(append_unit("Mean absolute error", facts.unit))
        panels.append(Panel(tuple(marks), ChartAxis(kind="names"), up, DOMAINS[domain]))
    return Chart("methods", tuple(panels), choices=(_horizons(facts),), height=120 + 240 * len(panels))
