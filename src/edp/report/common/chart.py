"""Figures as plain data; `interactive` draws them on a page, `picture` into files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edp.wording import unit_text

INK, SOFT, RULE, FRAME = "#26303a", "#66717d", "#e4e8ec", "#c4cbd2"
BLUE, GREY, DROPPED = "#0b57d0", "#3c4650", "#b4bcc5"
MUTED = ("#c9892f", "#5a9c8c", "#a97da0", "#8b929a", "#a5a04a", "#b9705c")
SHADES = (*MUTED, GREY)
"""Colours of equivalent series. The blue of the network is excluded."""
LINES = (BLUE, *SHADES)
DASHES: tuple[Dash, ...] = ("solid", "dash", "dot", "dashdot")
SEQUENTIAL = ("#f7fafe", "#b7d0f7", "#6d9fec", "#2567d3", "#062c74")
DIVERGING = ("#7a4a06", "#d79a3c", "#ffffff", "#6d9fec", "#062c74")
"""Diverging colour scale: orange for negative values, blue for positive values, with perceptually equal steps."""
ROUND_TICKS = tuple((float(step * 10**power), f"{step * 10 ** (power % 3)}{unit}")
                    for power, unit in zip(range(1, 10), ("", "", "k", "k", "k", "M", "M", "M", "G"))
                    for step in (1, 2, 5))  # fmt: skip
"""Ticks of a logarithmic axis of costs: 10, 20, 50 ... 1k ... 5G."""

Dash = Literal["solid", "dash", "dot", "dashdot"]
Symbol = Literal["", "circle", "ring", "diamond", "square", "triangle", "x", "cross", "star", "tick", "dash"]
SYMBOLS: tuple[Symbol, ...] = ("diamond", "square", "triangle", "x", "cross", "star")
"""Symbols of equivalent series, so that they do not differ in colour only."""
Values = Sequence[float | None] | NDArray[np.floating]
Positions = Sequence[float | None] | Sequence[str] | NDArray[np.floating] | NDArray[np.integer]


@dataclass(frozen=True)
class Evenly:
    """Positions at a fixed step, which take no room on a page."""

    start: float
    step: float


@dataclass(frozen=True)
class ChartAxis:
    """One axis of a panel.

    Attributes:
        title: title with the unit.
        titled_by: choice whose option is the title in a picture, where nobody can choose.
        kind: ``names`` has one position for each name, in the order in which the marks name them.
        limits: both ends, None for those of the data.
        ticks: position and text; none leaves them to the renderer.
        from_zero: whether zero is in sight.
        upside_down: whether values grow downwards or to the left.
        grid: whether hairlines cross the panel; None draws those of vertical axes.
        zero: colour of a line at zero; empty for none.
        shown: whether there is more of it than its positions.
        slant: degrees by which tick texts are turned.
        small: whether tick texts are small.
    """

    title: str = ""
    titled_by: str = ""
    kind: Literal["linear", "log", "names"] = "linear"
    limits: tuple[float, float] | None = None
    ticks: tuple[tuple[float, str], ...] = ()
    from_zero: bool = False
    upside_down: bool = False
    grid: bool | None = None
    zero: str = ""
    shown: bool = True
    slant: int = 0
    small: bool = False


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Element of a panel.

    Attributes:
        name: name in the legend; marks with one name share an entry, and an empty name has none.
        group: marks that the reader hides together; empty for those of the same name.
        when: option by choice for which it is shown; a choice that is not named does not matter.
        second: whether it belongs to the second vertical axis.
        hover: text at a point of a page, with ``{x}``, ``{y}`` and ``{label}`` as in `str.format`; None for no text.
        labels: text a point, for `hover`.
        remark: instead of the name beside that text; None for the name.
    """

    name: str = ""
    group: str = ""
    when: Mapping[str, str] = field(default_factory=dict)
    second: bool = False
    hover: str | None = "{y:.4g}"
    labels: Sequence[str] = ()
    remark: str | None = None


@dataclass(frozen=True, kw_only=True)
class DataSeries(Mark):
    """Points, joined by a line, marked by symbols, or both.

    Attributes:
        x, y: positions; None or NaN breaks the line.
        low, high: ends of a horizontal interval at each point; empty for none.
        colour: colour of line and symbols.
        width: width of the line in pixels; 0 for no line.
        dash: dash pattern of the line.
        step: ``after`` keeps a value up to the next position, ``middle`` to the middle between both.
        symbol, size: symbol of the points, and its size in pixels; empty for no symbols.
        edge: colour of a frame around the symbols; empty for none.
        opacity: 0 to 1.
        filled: whether the area to zero is tinted.
        clipped: whether what lies beyond the axes is cut off.
        rank: position in the legend, lower first.
    """

    x: Positions | Evenly
    y: Positions
    low: Values = ()
    high: Values = ()
    colour: str = BLUE
    width: float = 0.0
    dash: Dash = "solid"
    step: Literal["", "after", "middle"] = ""
    symbol: Symbol = ""
    size: float = 7.0
    edge: str = ""
    opacity: float = 1.0
    filled: bool = False
    clipped: bool = True
    rank: int = 1000


@dataclass(frozen=True, kw_only=True)
class Range(Mark):
    """The area between two lines over the same positions."""

    x: Positions | Evenly
    low: NDArray[np.floating]
    high: NDArray[np.floating]
    colour: str = BLUE


@dataclass(frozen=True, kw_only=True)
class Bars(Mark):
    """Bars from zero.

    Attributes:
        positions: positions: names or numbers.
        values: lengths of the bars.
        colours: colour of each bar.
        horizontal: whether they lie.
        low, high: ends of an interval at each bar; empty for none.
        valued: whether the value stands at the end of each bar.
        width: share of a position that a bar takes.
    """

    positions: Positions
    values: Values
    colours: Sequence[str]
    horizontal: bool = False
    low: Values = ()
    high: Values = ()
    valued: bool = False
    width: float = 0.66


@dataclass(frozen=True, kw_only=True)
class Cells(Mark):
    """A matrix as colours.

    Attributes:
        x, y: positions of columns and rows: names or numbers.
        values: ``(row, column)``, which colours show; NaN stays white.
        shown: values in the reader's unit, for `hover` as ``{label}``; None for `values`.
        scale: colours from the lowest to the highest.
        ends: values of the first and last colour.
        unit: unit above the colour bar.
        ticks: ticks of the colour bar; empty to leave them to the renderer.
        written: whether each cell holds its value.
        gap: whether a white hairline parts the cells.
        barred: whether the bar of colours stands beside; panels of one scale need one.
    """

    x: Positions
    y: Positions
    values: NDArray[np.floating]
    shown: NDArray[np.floating] | None = None
    scale: tuple[str, ...] = SEQUENTIAL
    ends: tuple[float, float] = (0.0, 1.0)
    unit: str = ""
    ticks: tuple[tuple[float, str], ...] = ()
    written: bool = False
    gap: bool = False
    barred: bool = True


@dataclass(frozen=True, kw_only=True)
class Texts(Mark):
    """Words at points of a panel, right of them and, if `raised`, above them."""

    x: Positions
    y: Positions
    texts: Sequence[str]
    raised: bool = False
    colour: str = INK
    hover: str | None = None


@dataclass(frozen=True, kw_only=True)
class GuideLine(Mark):
    """A line across a panel at a position of one axis, or up to `to` a band; it belongs to every choice."""

    x: float | None = None
    y: float | None = None
    to: float | None = None
    colour: str = SOFT
    width: float = 1.0
    dash: Dash = "solid"


@dataclass(frozen=True)
class Panel:
    """Marks in one pair of axes, with a second vertical axis where one is given; later marks lie above."""

    marks: tuple[Mark, ...]
    x: ChartAxis = field(default_factory=ChartAxis)
    y: ChartAxis = field(default_factory=ChartAxis)
    title: str = ""
    second: ChartAxis | None = None

    def select(self, chosen: Mapping[str, str]) -> Panel:
        """Return the panel with the marks of the chosen options."""
        return replace(self, marks=tuple(mark for mark in self.marks if fits(mark, chosen)))


@dataclass(frozen=True)
class Control:
    """A choice above a figure.

    Attributes:
        key: key by which marks refer to it (`Mark.when`).
        label: label of the selector.
        options: key and text of each; the first is shown first.
        keeps_zoom: whether another option keeps the axes where the reader left them.
        alone: whether a single option is shown, too.
    """

    key: str
    label: str
    options: tuple[tuple[str, str], ...]
    keeps_zoom: bool = False
    alone: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure: panels, row by row, and the choices that a reader has.

    Attributes:
        name: name on a page.
        panels: all of them.
        file: name of its pictures, with ``{key}`` for the option of a choice; empty writes none.
        title: title of a picture, with the texts of options in the same way; a page has its own headings.
        columns: panels beside each other.
        choices: choices of the reader; a picture is drawn for each combination.
        across: choice whose options a picture shows side by side instead.
        height: height on a page, pixels.
        inches: width and height of a picture; with `across` those of one option.
        legend: position of the legend.
        shares: fractions of the height per row, or of the width per column, if they differ.
        together: whether panels share their horizontal axis, and the pointer shows all series at a position.
    """

    name: str
    panels: tuple[Panel, ...]
    file: str = ""
    title: str = ""
    columns: int = 1
    choices: tuple[Control, ...] = ()
    across: str = ""
    height: int = 440
    inches: tuple[float, float] = (9.0, 4.4)
    legend: Literal["top", "right", "none"] = "top"
    shares: tuple[float, ...] = ()
    together: bool = False

    @property
    def rows(self) -> int:
        """Rows of panels."""
        return -(-len(self.panels) // self.columns)

    def first(self) -> Chart:
        """Return the chart with the first option of each choice, for media without choices."""
        chosen = {control.key: control.options[0][0] for control in self.choices}
        return replace(self, panels=tuple(panel.select(chosen) for panel in self.panels), choices=())

    def pictures(self) -> Iterator[Chart]:
        """Yield one chart without choices for each picture; title and axes state the chosen options."""
        across = next((control for control in self.choices if control.key == self.across), None)
        chosen_by = [control for control in self.choices if control is not across]
        for options in itertools.product(*(control.options for control in chosen_by)):
            texts = {control.key: text for control, (_, text) in zip(chosen_by, options)}
            chosen = {control.key: key for control, (key, _) in zip(chosen_by, options)}
            panels = [_set_title(panel.select(chosen), texts) for panel in self.panels]
            width, height = self.inches
            if across is not None:
                parts = [(text, panel.select({across.key: key})) for key, text in across.options for panel in panels]
                panels = [replace(panel, title=text) for text, panel in parts if panel.marks]
                width = max(width * len(panels), 7.0)  # one panel alone still has room for a title
            if any(panel.marks for panel in panels):
                yield replace(
                    self, name=_fill_text(self.file, chosen), title=_fill_text(self.title, texts), panels=tuple(panels),
                    columns=len(panels) if across else self.columns, choices=(), inches=(width, height),
                )  # fmt: skip


def fits(mark: Mark, chosen: Mapping[str, str]) -> bool:
    """Return whether a mark is shown for the options chosen."""
    return all(mark.when.get(key, option) == option for key, option in chosen.items())


def append_unit(text: str, unit: str) -> str:
    """Return an axis title with its unit in brackets."""
    shown = unit_text(unit)
    return f"{text} [{shown}]" if shown else text


def finite(value: float, digits: int = 5) -> float | None:
    """Return a value rounded to `digits` digits, which keeps pages small; None for a value that is not finite."""
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def _set_title(panel: Panel, texts: Mapping[str, str]) -> Panel:
    x = panel.x
    return replace(panel, x=replace(x, title=texts[x.titled_by])) if x.titled_by in texts else panel


def _fill_text(text: str, values: Mapping[str, str]) -> str:
    for key, value in values.items():
        text = text.replace(f"{{{key}}}", value)
    return text
