"""Drawings of a monitor's page as plain shapes: the template writes them as SVG, where all text is escaped.

Without plotly, whose script alone is larger than a page of a monitor may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edp.monitor.diagnosis.sentences import clock
from edp.monitor.traces import RecordingTrace, pooled
from edp.report.common.chart import BLUE, SHADES
from edp.report.monitor.facts import AlarmFacts, MonitorFacts, start_time
from edp.wording import label_by_name, number

FloatArray = NDArray[np.float32]
WIDTH = 960
LEFT, RIGHT = 200, 34
"""Margins of the drawing in pixels: group names on the left, half of the last tick label on the right."""
POINTS, CELLS, OVERVIEW_CELLS = 640, 320, 160
"""Maximum number of points of a line, cells of a row, and cells of an overview row. Finer data are pooled by their
maximum, which keeps the page small.
"""
PLOT_HEIGHT, ROW, TICKS_ROOM = 170, 17, 26
MAX_RATIO = 3.0
"""Maximum displayed ratio of a statistic to its limit."""
LEVELS = (1.5, 2.0, 3.0, 5.0)
"""Boundaries between the levels of a group. A group below the first boundary is healthy."""
SHADES_OF_LEVELS = ("#f1f4f7", "#dbe7fb", "#9dbff5", "#e0a458", "#b3261e")
MISSING_SHADE = "#ffffff"
MAX_EVIDENCE = 10
MAX_ROWS = 120
"""Maximum number of recordings in the overview."""
MARKS = {"stop": "#b3261e", "warning": "#8f5c10", "note": "#2f7566"}
TINTS = {"stop": "#f7dcda", "warning": "#f8ead6", "note": "#e0efeb"}


@dataclass(frozen=True)
class Box:
    """A filled rectangle with a text for the pointer."""

    x: float
    y: float
    width: float
    height: float
    colour: str
    text: str = ""


@dataclass(frozen=True)
class Patch:
    """Rectangles of one colour as one SVG path, with a text for the pointer."""

    path: str
    colour: str
    text: str


@dataclass(frozen=True)
class Polyline:
    """A line through points, as SVG has them."""

    points: str
    colour: str
    width: float = 1.4
    dash: str = ""


@dataclass(frozen=True)
class Label:
    """Words at a place; `anchor` as in SVG."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    colour: str = "#66717d"


@dataclass(frozen=True)
class Drawing:
    """Shapes on a sheet of `WIDTH` by `height` pixels."""

    height: float
    title: str
    boxes: tuple[Box, ...] = ()
    patches: tuple[Patch, ...] = ()
    lines: tuple[Polyline, ...] = ()
    labels: tuple[Label, ...] = ()
    legend: tuple[tuple[str, str], ...] = ()
    width: int = field(default=WIDTH)


def timeline(trace: RecordingTrace, facts: MonitorFacts) -> Drawing:
    """Return statistics of a recording over their limits, its alarms, and the levels of its residual groups below."""
    alarms = [alarm for alarm in facts.alarms if alarm.recording == trace.name]
    seconds = max(len(trace.ratios) * facts.traces.block_s, 1e-9)
    across = _across(seconds)
    lines = [Polyline(_path([(LEFT, _height(1.0)), (WIDTH - RIGHT, _height(1.0))]), "#b3261e", 1.0, "5 4")]
    ratios, factor = pooled(trace.ratios, POINTS)
    step = factor * facts.traces.block_s
    for n in range(len(facts.traces.detectors)):
        points = [(across(min((k + 0.5) * step, seconds)), _height(value)) for k, value in enumerate(ratios[:, n])]
        lines.append(Polyline(_path(points), (BLUE, *SHADES)[n % (1 + len(SHADES))]))
    boxes, labels = [], [Label(LEFT - 6, _height(1.0) + 4, "limit", "end", "#b3261e")]
    labels += [Label(LEFT - 6, _height(value) + 4, number(value, 0), "end") for value in (0.0, 2.0, 3.0)]
    for alarm in alarms:
        left, right = across(max(alarm.since_s, 0.0)), across(min(alarm.raised_s, seconds))
        text = f"{alarm.severity}: {alarm.sentence}"
        boxes.append(Box(left, 8, max(right - left, 1.0), PLOT_HEIGHT - 8, TINTS[alarm.severity], text))
        boxes.append(Box(right - 1.5, 8, 3.0, PLOT_HEIGHT - 8, MARKS[alarm.severity], text))
    rows, row_labels = _group_rows(trace, facts, across)
    bottom = PLOT_HEIGHT + 12 + ROW * len(facts.traces.groups)
    labels += [*row_labels, *_ticks(seconds, across, bottom, trace)]
    legend = tuple((name, (BLUE, *SHADES)[n % (1 + len(SHADES))]) for n, name in enumerate(facts.traces.detectors))
    return Drawing(
        bottom + TICKS_ROOM, f"Statistics and residual groups of {trace.name}", tuple(boxes), tuple(rows), tuple(lines),
        tuple(labels), legend,
    )  # fmt: skip


def overview(facts: MonitorFacts) -> Drawing:
    """Return one row per recording: the largest statistic over its limit as a shade, alarms as marks."""
    traces = facts.traces.recordings
    if len(traces) > MAX_ROWS:
        with_alarms = {alarm.recording for alarm in facts.alarms}
        traces = tuple(sorted(traces, key=lambda trace: trace.name not in with_alarms))[:MAX_ROWS]
    longest = max((len(trace.ratios) for trace in traces), default=1) * facts.traces.block_s
    across = _across(max(longest, 1e-9))
    boxes, labels, patches = [], [], []
    names = label_by_name(trace.name for trace in traces)
    for n, trace in enumerate(traces):
        top = 4 + ROW * n
        worst = trace.ratios.max(axis=1, initial=0.0)[:, None]
        row = CellRow(top, facts.traces.block_s, across, trace.name, OVERVIEW_CELLS)
        patches += _cells(worst * LEVELS[2], row, NEARNESS)
        for alarm in facts.alarms:
            if alarm.recording == trace.name:
                at, text = across(min(alarm.raised_s, longest)), f"{alarm.severity}: {alarm.sentence}"
                boxes.append(Box(at - 2.5, top - 1, 5.0, ROW - 1, MARKS[alarm.severity], text))
        labels.append(Label(LEFT - 6, top + ROW - 6, names[trace.name], "end", "#26303a"))
    bottom = 6 + ROW * len(traces)
    labels += _ticks(longest, across, bottom, None)
    return Drawing(bottom + TICKS_ROOM, "All recordings", tuple(boxes), tuple(patches), (), tuple(labels))


def evidence(alarm: AlarmFacts) -> Drawing:
    """Return the deviations of residual summaries since the onset, in healthy standard deviations."""
    shown = alarm.evidence[:MAX_EVIDENCE]
    most = max([abs(value) for _, value in shown] + [1.0])
    left, right = 260, 70
    middle, half = left + (WIDTH - left - right) / 2, (WIDTH - left - right) / 2
    boxes, labels = [Box(middle - 0.5, 2, 1.0, ROW * len(shown) + 2, "#c4cbd2")], []
    names = label_by_name(name for name, _ in shown)
    for n, (name, value) in enumerate(shown):
        top, reach = 4 + ROW * n, half * abs(value) / most
        start = middle if value >= 0.0 else middle - reach
        text = f"{name}: {number(value, 1, signed=True)} standard deviations"
        boxes.append(Box(start, top, max(reach, 1.0), ROW - 5, BLUE if value >= 0.0 else "#c9892f", text))
        labels.append(Label(left - 8, top + ROW - 7, names[name], "end", "#26303a"))
        labels.append(Label(WIDTH - right + 8, top + ROW - 7, number(value, 1, signed=True)))
    return Drawing(ROW * len(shown) + 8, "Evidence", tuple(boxes), (), (), tuple(labels))


def _group_rows(trace: RecordingTrace, facts: MonitorFacts, across: Across) -> tuple[list[Patch], list[Label]]:
    patches: list[Patch] = []
    labels: list[Label] = []
    names = label_by_name(facts.traces.groups)
    for n, name in enumerate(facts.traces.groups):
        top = PLOT_HEIGHT + 8 + ROW * n
        row = CellRow(top, facts.traces.block_s, across, name, CELLS)
        patches += _cells(trace.groups[:, n : n + 1], row, LEVEL_TEXTS)
        labels.append(Label(LEFT - 6, top + ROW - 6, names[name], "end", "#26303a"))
    return patches, labels


@dataclass(frozen=True)
class CellRow:
    """Position, name and largest number of cells of a row of shades."""

    top: float
    block_s: float
    across: Across
    name: str
    most: int


def _cells(values: FloatArray, row: CellRow, texts: Sequence[str]) -> list[Patch]:
    """Return a row of shades, one patch per shade; equal neighbours are one rectangle."""
    levels, factor = pooled(values, row.most)
    steps = np.where(np.isnan(levels[:, 0]), -1, np.searchsorted(LEVELS, levels[:, 0], side="right"))
    if len(steps) == 0:
        return []
    edges = np.concatenate([[0], np.flatnonzero(steps[1:] != steps[:-1]) + 1, [len(steps)]])
    total = len(values) * row.block_s
    paths: dict[int, list[str]] = {}
    for first, behind in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        left, right = (row.across(min(edge * factor * row.block_s, total)) for edge in (first, behind))
        rectangle = f"M{left:g} {row.top:g}h{max(right - left, 0.5):.4g}v{ROW - 3}h{-max(right - left, 0.5):.4g}z"
        paths.setdefault(int(steps[first]), []).append(rectangle)
    return [
        Patch(
            "".join(paths[step]),
            MISSING_SHADE if step < 0 else SHADES_OF_LEVELS[step],
            f"{row.name}: {'silent' if step < 0 else texts[step]}",
        )
        for step in sorted(paths)
    ]


LEVEL_TEXTS = ("as healthy", *(f"{value:g} times healthy and above" for value in LEVELS))
NEARNESS = (
    "below half of the limit",
    "from half of the limit on",
    "from two thirds of the limit on",
    "above the limit",
    "far above the limit",
)


class Across:
    """Seconds to pixels."""

    def __init__(self, seconds: float) -> None:
        self.scale = (WIDTH - LEFT - RIGHT) / seconds

    def __call__(self, seconds: float) -> float:
        """Return the horizontal position of a time."""
        return round(LEFT + seconds * self.scale, 1)


def _across(seconds: float) -> Across:
    return Across(seconds)


def _height(ratio: float) -> float:
    value = min(max(float(ratio), 0.0), MAX_RATIO) if np.isfinite(ratio) else 0.0
    return round(PLOT_HEIGHT - (PLOT_HEIGHT - 16) * value / MAX_RATIO, 1)


def _path(points: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:g},{y:g}" for x, y in points)


def _ticks(seconds: float, across: Across, bottom: float, trace: RecordingTrace | None) -> list[Label]:
    """Return the time labels below a drawing: time of day if the recording's start is known."""
    start = start_time(trace.start) if trace is not None else None
    steps = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 43200, 86400)
    step = next((value for value in steps if seconds / value <= 10), steps[-1])
    times = np.arange(0.0, seconds + 1e-9, step)[:40]
    return [Label(across(float(time)), bottom + 16, clock(float(time), start), "middle") for time in times]
