"""Figures of a twin: free runs with their intervals, and the error over the horizon."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.evaluation.free_run_file import PARTS, TWIN, StepResponses
from edp.recording import Recording
from edp.report.common.chart import (
    BLUE,
    DROPPED,
    GREY,
    MUTED,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Evenly,
    Mark,
    Panel,
    Range,
    append_unit,
    finite,
)  # fmt: skip
from edp.report.common.picture import write_pictures
from edp.report.twin.facts import FreeRunFacts
from edp.signals import KINDS, Kind, display_offset
from edp.wording import figure, label_by_name

RECORDING, MODEL, COMMAND = "recording", "model", "command"
MAX_PANELS = 6
"""Maximum number of panels of step responses."""
DIGITS = 4
"""Number of significant digits of plotted values, which is above the resolution of a picture and saves bytes."""
MAX_DRAWN = 4_000
"""Maximum number of points of a line, above the resolution of a picture."""
KINDS_DRAWN = {
    "velocities": (Kind.VELOCITY, Kind.ANGULAR_VELOCITY),
    "strokes": (Kind.POSITION, Kind.ANGLE),
    "pressures": (Kind.PRESSURE,),
}


def twin_charts(facts: FreeRunFacts) -> list[Chart]:
    """Return every figure of the page: ``runs_velocities`` and so on, ``horizon``, and ``steps``."""
    runs = [runs_chart(facts, part) for part in PARTS if facts.channels(part) and facts.names]
    steps = None if facts.steps is None else steps_chart(facts.steps)
    return [*runs, horizon_chart(facts), *([] if steps is None else [steps])]


def runs_chart(facts: FreeRunFacts, part: str) -> Chart:
    """Return measured channels and the twin's outputs with their intervals; one row per channel of a part."""
    seconds, half = facts.shown["seconds"], facts.shown.get("half_width")
    # Shown runs are thinned out evenly, so a start and a step are all that a line needs.
    time_s = Evenly(round(float(seconds[0]), 6), round(float((seconds[-1] - seconds[0]) / (len(seconds) - 1)), 6))
    labels = label_by_name(channel.name for one in PARTS for channel in facts.channels(one))
    panels = []
    for channel, column in zip(facts.channels(part), facts.columns(part), strict=True):
        marks: list[Mark] = []
        for name in facts.names:
            when, factor = {RECORDING: name}, channel.factor
            offset = display_offset(channel.unit)
            answers, truth = (factor * facts.shown[f"{name}/{key}"][:, column] + offset for key in ("answers", "truth"))
            if half is not None:
                reach = factor * half[:, column]
                low, high = (np.array(_short(ends), dtype=float) for ends in (answers - reach, answers + reach))
                marks.append(Range(x=time_s, low=low, high=high, name="Interval", hover=None, when=when))
            marks.append(DataSeries(x=time_s, y=_short(truth), name="Measured", colour=GREY, width=2.6, when=when))
            label = "Twin, on commands alone"
            marks.append(DataSeries(x=time_s, y=_short(answers), name=label, width=1.4, when=when))
        title = append_unit(labels[channel.name], channel.unit)
        panels.append(Panel(tuple(marks), ChartAxis("Time since the last measured tick [s]"), title=title))
    choice = Control(RECORDING, "Recording", tuple((name, name) for name in facts.names))
    return Chart(f"runs_{part}", tuple(panels), choices=(choice,), height=90 + 190 * len(panels), together=True)


def horizon_chart(facts: FreeRunFacts) -> Chart:
    """Return the mean absolute error over the horizon, a panel for each kind of channel.

    And half widths of the intervals.
    """
    half, seconds = facts.shown.get("half_width"), facts.shown["seconds"]
    panels: list[Panel] = []
    for part in PARTS:
        if not facts.twin.by_horizon.part(part).by_channel:
            continue
        marks: list[Mark] = []
        for model, scores in facts.models.items():
            by_horizon, when = scores.by_horizon, {MODEL: model}
            by_channel = by_horizon.part(part).by_channel
            labels = label_by_name(name for one in PARTS for name in by_horizon.part(one).by_channel)
            for index, (name, values) in enumerate(by_channel.items()):
                label, colour = labels[name], MUTED[index % len(MUTED)]
                errors = _short(np.array(values, dtype=np.float64))
                marks.append(DataSeries(
                    x=by_horizon.seconds, y=errors, name=label, colour=colour, width=2, hover="{y:.3g}", when=when
                ))  # fmt: skip
                channels = facts.channels(part)
                if model == TWIN and half is not None and len(channels) == len(by_channel):
                    # Half widths grow slowly: 60 points, evenly spread on the logarithmic axis, show them.
                    at = np.unique(np.geomspace(1, len(seconds), 60).astype(np.int64)) - 1
                    widths = half[at, facts.columns(part)[index]] * channels[index].factor
                    marks.append(DataSeries(
                        x=_short(seconds[at]), y=_short(widths), group=label, colour=colour, width=1.2, dash="dot",
                        hover="{y:.3g}", remark=f"{label}, half width of its interval", when=when,
                    ))  # fmt: skip
        across = ChartAxis("Time since the last measured tick [s]", kind="log")
        up = ChartAxis("" if panels else "Mean absolute error", from_zero=True)
        title = append_unit(part.capitalize(), facts.twin.by_horizon.part(part).unit or "")
        panels.append(Panel(tuple(marks), across, up, title))
    options = tuple((model, "The twin" if model == TWIN else f"Floor: {model}") for model in facts.models)
    choice = Control(MODEL, "Model", options)
    return Chart("horizon", tuple(panels), columns=len(panels), choices=(choice,), height=460)


def steps_chart(steps: StepResponses) -> Chart | None:
    """Return the response of each output to a step of the chosen command; None without steps."""
    if not steps.steps:
        return None
    seconds, panels = steps.seconds, []
    labels = label_by_name(answer.name for answer in steps.steps[0].answers)
    for row, first in enumerate(steps.steps[0].answers[:MAX_PANELS]):
        marks: list[Mark] = []
        for step in steps.steps:
            answer, when = step.answers[row], {COMMAND: step.command}
            low, high = np.array(answer.low), np.array(answer.high)
            marks.append(Range(x=seconds, low=low, high=high, name="Middle 80 % of the moments", hover=None, when=when))
            marks.append(DataSeries(x=seconds, y=answer.median, name="Median", width=1.8, when=when))
        title = append_unit(labels[first.name], first.unit)
        panels.append(Panel(tuple(marks), ChartAxis("Time since the step [s]"), title=title))
    options = tuple((step.command, f"{step.command}, step of {figure(step.size)} {step.unit}") for step in steps.steps)
    return Chart(
        "steps", tuple(panels), columns=2, choices=(Control(COMMAND, "Command", options),),
        height=80 + 210 * -(-len(panels) // 2),
    )  # fmt: skip


def _short(values: NDArray[np.floating]) -> list[float | None]:
    return [finite(float(value), DIGITS) for value in values]


def write_rollout_plots(rollout: Recording, suffix: str, start_s: float, folder: str | Path) -> list[Path]:
    """Write ``velocities``, ``strokes`` and ``pressures`` as SVG and PNG, a row for each channel.

    Args:
        rollout: measured channels, outputs under the same names with `suffix` behind, and the ends of their intervals
            with ``_low`` and ``_high`` behind that, where there are some.
        suffix: suffix of the names of outputs.
        start_s: time of the log at the first row.
        folder: output folder, which is created.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    charts = []
    for name, kinds in KINDS_DRAWN.items():
        columns = [c.name for c in rollout.channels if c.kind in kinds and f"{c.name}{suffix}" in rollout.channel_names]
        if columns:
            charts.append(_rollout_chart(name, rollout, columns, suffix, start_s))
    return write_pictures(folder, charts)


def _rollout_chart(name: str, rollout: Recording, columns: list[str], suffix: str, start_s: float) -> Chart:
    # Ends belong to the picture: how far a free run is off in the end is what it shows.
    at = np.unique(np.linspace(0, rollout.samples - 1, MAX_DRAWN).astype(int))
    time_s = start_s + at / rollout.rate_hz
    panels, labels = [], label_by_name(columns)
    for column in columns:
        facts = KINDS[rollout.channels[rollout.index(column)].kind]
        names = (column, f"{column}{suffix}", f"{column}{suffix}_low", f"{column}{suffix}_high")
        drawn = [facts.to_report(rollout.column(n)[at]) for n in names if n in rollout.channel_names]
        marks: list[Mark] = []
        if len(drawn) == len(names):
            marks.append(Range(x=time_s, low=drawn[2], high=drawn[3], name="interval"))
        marks.append(DataSeries(x=time_s, y=drawn[0], name="measured", colour=DROPPED, width=3.6))
        marks.append(DataSeries(x=time_s, y=drawn[1], name="answered by the twin", colour=BLUE, width=1.4))
        vertical = ChartAxis(append_unit(f"{labels[column]}\n", facts.report_unit))
        panels.append(Panel(tuple(marks), ChartAxis("Time in the log [s]"), vertical))
    size = (8.0, 1.3 * len(columns) + 0.9)
    return Chart(name, tuple(panels), file=name, inches=size, height=90 + 130 * len(columns), together=True)
