"""Figures of closed loops: the path, errors, strokes and levers over time, times of the controller's steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.recording import Recording
from edp.report.common.chart import (
    BLUE,
    GREY,
    MUTED,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    Evenly,
    Mark,
    Panel,
    finite,
)
from edp.report.control.facts import ControlFacts

Array = NDArray[np.floating]
LOOP = "loop"
DIGITS = 5
MAX_DRAWN = 1_500
"""Maximum number of points of a line, above the resolution of a page."""
AXES = ("Boom", "Arm", "Bucket")


def control_charts(facts: ControlFacts) -> list[Chart]:
    """Return every figure of the page: ``path``, ``errors``, ``strokes``, ``levers`` and ``solver``."""
    choice = Control(LOOP, "Loop", tuple((str(n), loop.name) for n, loop in enumerate(facts.content.loops)))
    return [
        path_chart(facts, choice),
        errors_chart(facts, choice),
        strokes_chart(facts, choice),
        levers_chart(facts, choice),
        solver_chart(facts, choice),
    ]


def path_chart(facts: ControlFacts, choice: Control) -> Chart:
    """Return the path of the tip and the reference in side view."""
    marks: list[Mark] = []
    for n, recording in enumerate(facts.recordings):
        when, rows = {LOOP: str(n)}, drawn_rows(recording)
        tip, reference = tip_of(recording)[rows], reference_of(recording)[rows]
        marks.append(DataSeries(
            x=_short(reference[:, 0]), y=_short(reference[:, 1]), name="Reference", colour=GREY, width=3.2, when=when
        ))  # fmt: skip
        marks.append(DataSeries(x=_short(tip[:, 0]), y=_short(tip[:, 1]), name="Bucket tip", width=1.6, when=when))
    axes = (ChartAxis("Forward of the boom foot [m]", grid=True), ChartAxis("Above the boom foot [m]", grid=True))
    return Chart("path", (Panel(tuple(marks), *axes),), choices=(choice,), height=460)


def errors_chart(facts: ControlFacts, choice: Control) -> Chart:
    """Return the position error and attitude error over time."""
    position: list[Mark] = []
    attitude: list[Mark] = []
    for n, recording in enumerate(facts.recordings):
        when, rows = {LOOP: str(n)}, drawn_rows(recording)
        difference = (tip_of(recording) - reference_of(recording))[rows]
        time = evenly(recording, rows)
        distance = 1e3 * np.hypot(difference[:, 0], difference[:, 1])
        turned = np.degrees(np.angle(np.exp(1j * difference[:, 2])))
        position.append(DataSeries(x=time, y=_short(distance), name="Position error", width=1.6, when=when))
        attitude.append(DataSeries(
            x=time, y=_short(turned), name="Attitude error", colour=MUTED[0], width=1.6, when=when
        ))  # fmt: skip
    across = ChartAxis("Time [s]")
    panels = (
        Panel(tuple(position), across, ChartAxis("[mm]", from_zero=True), title="Position error of the tip"),
        Panel(tuple(attitude), across, ChartAxis("[deg]"), title="Attitude error of the bucket"),
    )
    return Chart("errors", panels, choices=(choice,), height=460, together=True, legend="none")


def strokes_chart(facts: ControlFacts, choice: Control) -> Chart:
    """Return the stroke minus its reference, for each cylinder."""
    panels = []
    for i, name in enumerate(AXES, start=1):
        marks: list[Mark] = []
        for n, recording in enumerate(facts.recordings):
            rows = drawn_rows(recording)
            error = recording.column(f"CylStroke_{i}_true") - recording.column(f"Reference_CylStroke_{i}")
            marks.append(DataSeries(
                x=evenly(recording, rows), y=_short(1e3 * error[rows]), name="Stroke error", width=1.6,
                when={LOOP: str(n)},
            ))  # fmt: skip
        panels.append(Panel(tuple(marks), ChartAxis("Time [s]"), ChartAxis("[mm]"), title=f"{name}: stroke error"))
    return Chart("strokes", tuple(panels), choices=(choice,), height=560, together=True, legend="none")


def levers_chart(facts: ControlFacts, choice: Control) -> Chart:
    """Return the lever positions over time."""
    marks: list[Mark] = []
    colours = (BLUE, MUTED[0], MUTED[1])
    for n, recording in enumerate(facts.recordings):
        rows = drawn_rows(recording)
        for i, name in enumerate(AXES, start=1):
            marks.append(DataSeries(
                x=evenly(recording, rows), y=_short(recording.column(f"Lever_{i}")[rows]), name=name,
                colour=colours[i - 1], width=1.6, when={LOOP: str(n)},
            ))  # fmt: skip
    panel = Panel(tuple(marks), ChartAxis("Time [s]"), ChartAxis("Lever, share of full", limits=(-1.05, 1.05)))
    return Chart("levers", (panel,), choices=(choice,), height=360)


def solver_chart(facts: ControlFacts, choice: Control) -> Chart:
    """Return the distribution of the controller's time per step."""
    marks: list[Mark] = []
    share = np.linspace(0.0, 1.0, 201)
    for n, times in enumerate(facts.solve_us):
        marks.append(DataSeries(
            x=_short(np.quantile(times, share)), y=_short(100 * share), name="Share of steps", width=2,
            when={LOOP: str(n)},
        ))  # fmt: skip
    panel = Panel(tuple(marks), ChartAxis("Time of a step [µs]", kind="log"), ChartAxis("Steps below it [%]"))
    return Chart("solver", (panel,), choices=(choice,), height=320, legend="none")


def tip_of(recording: Recording) -> Array:
    """Return true tip x, y (m) and attitude (rad), shape (ticks, 3)."""
    return recording.select(("TipX_true", "TipY_true", "TipAngle_true"))


def reference_of(recording: Recording) -> Array:
    """Return the reference of the tip, shape (ticks, 3)."""
    return recording.select(("Reference_TipX", "Reference_TipY", "Reference_TipAngle"))


def drawn_rows(recording: Recording) -> slice:
    """Return the rows of plotted lines, evenly spread."""
    return slice(0, None, max(1, recording.samples // MAX_DRAWN))


def evenly(recording: Recording, rows: slice) -> Evenly:
    """Return the times of the plotted rows."""
    return Evenly(0.0, (rows.step or 1) / recording.rate_hz)


def _short(values: Array) -> list[float | None]:
    return [finite(float(value), DIGITS) for value in values]
