"""Draws charts into files, SVG and PNG, by matplotlib, which needs no browser."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edp.report.common.chart import (
    BLUE,
    DROPPED,
    FRAME,
    INK,
    RULE,
    SOFT,
    Bars,
    Cells,
    Chart,
    ChartAxis,
    DataSeries,
    Evenly,
    GuideLine,
    Mark,
    Panel,
    Range,
    Texts,
)  # fmt: skip
from edp.storage import make_folder, write_bytes
from edp.wording import printable_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["BLUE", "DROPPED", "INK", "NOT_XML", "draw_png", "file_name", "write_drawings", "write_pictures"]

DPI = 150
FORMATS = ("svg", "png")
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Pattern of characters that XML 1.0 forbids even as escapes. Channel names may contain them."""
POINTS = 0.66
"""Points of a picture per pixel of a page: 9-point text fits lines designed for 13 pixels."""
MOST_TICKS = 8
DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}
STEPS = {"": "default", "after": "steps-post", "middle": "steps-mid"}
SYMBOLS = {
    "circle": "o", "ring": "o", "diamond": "D", "square": "s", "triangle": "^", "x": "x", "cross": "P", "star": "*",
    "tick": "|", "dash": "_",
}  # fmt: skip
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same picture on every machine
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": FRAME,
    "axes.labelcolor": SOFT,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "svg.fonttype": "none",
    "svg.hashsalt": "edp",
    "text.parse_math": False,
}


def write_pictures(folder: str | Path, charts: Iterable[Chart]) -> list[Path]:
    """Return every picture of every chart in every format, in order, in a folder that is made.

    Equal charts give equal bytes.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    pictures = [picture for chart in charts if chart.file for picture in chart.pictures()]
    drawings = {file_name(picture.name): partial(draw, chart=picture) for picture in pictures}
    return write_drawings(folder, drawings) if drawings else []


def write_drawings(folder: str | Path, drawings: Mapping[str, Callable[[Figure], None]]) -> list[Path]:
    """Write drawings by functions that draw into a matplotlib figure; keys are file names.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    target = make_folder(folder)
    return [path for name, draw in drawings.items() for path in _write(target, name, draw)]


def draw_png(chart: Chart, dpi: int = DPI) -> bytes:
    """Return a chart without choices as a PNG image."""
    return _draw_formats(partial(draw, chart=chart), dpi)["png"]


def _write(folder: Path, name: str, draw: Callable[[Figure], None]) -> list[Path]:
    for suffix, content in _draw_formats(draw, DPI).items():
        write_bytes(folder / f"{name}.{suffix}", content)
    return [folder / f"{name}.{suffix}" for suffix in FORMATS]


def _draw_formats(draw: Callable[[Figure], None], dpi: int) -> dict[str, bytes]:
    """Return the content of the picture in each format."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    bytes_of, vector = io.BytesIO(), io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(dpi=dpi, layout="constrained")
        bitmap = FigureCanvasAgg(figure)
        draw(figure)
        for text in figure.findobj(Text):
            text.set_text(printable_lines(text.get_text()))
        layout = figure.get_layout_engine()
        if layout is not None:
            layout.execute(figure)
            figure.set_layout_engine("none")  # laid out once, not for every format
        # No program name and no date: equal content gives equal bytes.
        bitmap.print_png(bytes_of, metadata={"Software": None})
        FigureCanvasSVG(figure).print_svg(vector, metadata={"Date": None})
    return {"svg": NOT_XML.sub("\ufffd", vector.getvalue()).encode(), "png": bytes_of.getvalue()}


def file_name(target: str) -> str:
    """Return a name that is valid on any file system."""
    # 80 characters stay within the limit of every file system, with a suffix behind them.
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in target)[:80] or "target"


def draw(figure: Figure, chart: Chart) -> None:
    """Draw a chart without choices (`Chart.pictures`)."""
    figure.set_size_inches(*chart.inches)
    rows, columns = chart.rows, chart.columns
    shares = (
        {"width_ratios" if len(chart.shares) == columns > 1 else "height_ratios": chart.shares} if chart.shares else {}
    )
    grid: Any = figure.subplots(
        rows, columns, sharex=chart.together, sharey="width_ratios" in shares, squeeze=False, gridspec_kw=shares
    )
    entries: dict[str, Any] = {}
    for axes, panel in zip(grid.flat, chart.panels):
        _panel(axes, panel, entries)
    for axes in grid.flat[len(chart.panels) :]:
        axes.set_visible(False)
    for axes in grid[:-1].flat if chart.together else ():
        axes.set_xlabel("")
    if chart.legend != "none" and entries:
        anchor = (
            {"loc": "outside right upper"} if chart.legend == "right" else {"loc": "outside upper right", "ncols": 4}
        )
        figure.legend(entries.values(), entries.keys(), **anchor)
    if chart.title:
        figure.suptitle(chart.title, x=0.01, ha="left", fontsize=11, weight="bold")


def _panel(axes: Axes, panel: Panel, entries: dict[str, object]) -> None:
    second: Any = axes.twinx() if panel.second is not None else None
    names = {way: _names(panel, way) for way in "xy"}
    beside = [mark for mark in panel.marks if isinstance(mark, Bars)]
    for layer, mark in enumerate(panel.marks, 2):
        drawn = _draw(mark, second if mark.second else axes, names, layer, beside)
        if mark.name and drawn is not None:
            entries.setdefault(mark.name, drawn)
    axes.set_title(panel.title)
    _finish(axes, panel.x, "x", names["x"])
    _finish(axes, panel.y, "y", names["y"])
    if second is not None and panel.second is not None:
        second.spines["right"].set_visible(False)
        _finish(second, panel.second, "y", {})


def _names(panel: Panel, way: str) -> dict[str, int]:
    """Place of each name on an axis, in the order in which the marks name them."""
    names: dict[str, int] = {}
    for mark in panel.marks:
        positions = (
            mark.positions if isinstance(mark, Bars) and mark.horizontal == (way == "y") else getattr(mark, way, None)
        )
        for name in positions if isinstance(positions, list | tuple) else ():
            if isinstance(name, str):
                names.setdefault(name, len(names))
    return names


def _axis_positions(positions: Any, names: Mapping[str, int], count: int) -> NDArray[np.float64]:
    if isinstance(positions, Evenly):
        return np.asarray(positions.start + positions.step * np.arange(count), dtype=np.float64)
    return np.array(
        [names[at] if isinstance(at, str) else np.nan if at is None else at for at in positions], dtype=float
    )


def _finish(axes: Axes, axis: ChartAxis, way: str, names: Mapping[str, int]) -> None:
    """Scale, limits, ticks and title of one axis."""
    upright = way == "y"
    own: Any = axes.yaxis if upright else axes.xaxis
    get_limits: Any = axes.get_ylim if upright else axes.get_xlim
    set_limits: Any = axes.set_ylim if upright else axes.set_xlim
    axes.grid(visible=upright if axis.grid is None else axis.grid, axis="y" if upright else "x")
    own.set_label_text(axis.title)
    if not axis.shown:
        own.set_visible(False)
        axes.spines["left" if upright else "bottom"].set_visible(False)
    if axis.kind == "log":
        (axes.set_yscale if upright else axes.set_xscale)("log")
        own.set_major_formatter("{x:g}")  # the scale's own texts are formulas
    if axis.from_zero:
        lowest = axes.dataLim.y0 if upright else axes.dataLim.x0
        set_limits(get_limits()[0] if lowest < 0 else 0.0, get_limits()[1])
    limits = (-0.6, len(names) - 0.4) if axis.kind == "names" else axis.limits
    if limits is not None:
        set_limits(*limits)
    low, high = sorted(get_limits())
    ticks = [(float(at), name) for name, at in names.items()] or [
        (at, text) for at, text in axis.ticks if low <= at <= high
    ]
    if ticks:
        shown = ticks if names else ticks[:: -(-len(ticks) // MOST_TICKS)]
        turned = {"rotation": axis.slant, "ha": "right", "rotation_mode": "anchor"} if axis.slant else {}
        small = 5 if axis.small else 7 if names else 8
        own.set_ticks([at for at, _ in shown], [text for _, text in shown], fontsize=small, **turned)
        own.set_ticks([], minor=True)
    if names:
        own.set_tick_params(length=0)
    if axis.upside_down:
        set_limits(high, low)
    if axis.zero:
        (axes.axhline if upright else axes.axvline)(0, color=axis.zero, linewidth=0.8, zorder=1)


@singledispatch
def _draw(mark: Mark, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    """Draw a mark and return its legend entry; `bars` are the bar marks of the panel, drawn in groups."""
    raise TypeError(f"no drawing for {type(mark).__name__}")


@_draw.register(DataSeries)
def _(mark: DataSeries, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    y = _axis_positions(mark.y, names["y"], 0)
    x = _axis_positions(mark.x, names["x"], len(y))
    width = mark.width * POINTS
    if len(mark.low):
        ends = np.array([mark.low, mark.high], dtype=float)  # None becomes NaN, which draws nothing
        axes.errorbar(
            x, y, xerr=np.abs(ends - x), fmt="none", ecolor=mark.colour, elinewidth=1.1, capsize=2.5, zorder=layer
        )
    if mark.filled:
        axes.fill_between(
            x, y, step="mid" if mark.step == "middle" else None, color=mark.colour, alpha=0.16, linewidth=0
        )
    (line,) = axes.plot(
        x, y, color=mark.colour, linewidth=width, linestyle=DASHES[mark.dash] if width else "none", zorder=layer,
        drawstyle=STEPS[mark.step], marker=SYMBOLS.get(mark.symbol, ""), markersize=mark.size * POINTS,
        markerfacecolor="none" if mark.symbol == "ring" else mark.colour, markeredgecolor=mark.edge or mark.colour,
        markeredgewidth=1.3 if mark.edge else 0.8, alpha=mark.opacity, clip_on=mark.clipped,
    )  # fmt: skip
    return line


@_draw.register(Range)
def _(mark: Range, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    x = _axis_positions(mark.x, names["x"], len(mark.low))
    return axes.fill_between(x, mark.low, mark.high, color=mark.colour, alpha=0.16, linewidth=0, zorder=layer)


@_draw.register(Bars)
def _(mark: Bars, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    values = np.array(mark.values, dtype=float)
    width = mark.width / len(bars)
    order = [other is mark for other in bars].index(True)
    positions = (
        _axis_positions(mark.positions, names["y" if mark.horizontal else "x"], 0)
        + (order - (len(bars) - 1) / 2) * width
    )
    ends = np.array([mark.low, mark.high], dtype=float)
    reach = np.nan_to_num(np.maximum(np.stack((values - ends[0], ends[1] - values)), 0.0)) if len(mark.low) else None
    lines: Any = {
        "error_kw": {"ecolor": INK, "elinewidth": 0.8, "capsize": 1.5},
        "color": mark.colours,
        "zorder": layer,
    }
    drawn = axes.barh(positions, values, width, xerr=reach, **lines) if mark.horizontal else axes.bar(
        positions, values, width, yerr=reach, **lines)  # fmt: skip
    if mark.valued:
        axes.bar_label(drawn, fmt="{:.3g}", padding=3, fontsize=8)
    return drawn


@_draw.register(Cells)
def _(mark: Cells, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("edp", mark.scale)
    x, y = _axis_positions(mark.x, names["x"], 0), _axis_positions(mark.y, names["y"], 0)
    values = np.ma.masked_invalid(mark.values)
    frame: Any = {"edgecolors": "white", "linewidth": 0.6} if mark.gap else {}
    drawn = axes.pcolormesh(x, y, values, cmap=colours, vmin=mark.ends[0], vmax=mark.ends[1], rasterized=True, **frame)
    top = max(map(abs, mark.ends))
    for row, column in np.argwhere(np.isfinite(mark.values)).tolist() if mark.written else ():
        value = float(mark.values[row, column])
        # White on the dark end of the scale; 0.55 of it is where black on it is as hard to read.
        ink = "white" if abs(value) > 0.55 * top else INK
        axes.text(x[column], y[row], f"{value:.2f}".replace("-", "−"), ha="center", va="center", fontsize=5.5,
                  color=ink, in_layout=False)  # fmt: skip
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    if not mark.barred:
        return drawn
    bar = axes.figure.colorbar(drawn, ax=axes, fraction=0.03, pad=0.015)
    bar.outline.set_visible(False)
    bar.ax.set_title(mark.unit, fontsize=8, color=SOFT)
    if mark.ticks:
        bar.set_ticks([at for at, _ in mark.ticks], labels=[text for _, text in mark.ticks])
    return drawn


@_draw.register(Texts)
def _(mark: Texts, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    for x, y, text in zip(
        _axis_positions(mark.x, names["x"], 0), _axis_positions(mark.y, names["y"], 0), mark.texts, strict=True
    ):
        axes.annotate(
            text, (x, y), (4, 4 if mark.raised else 0), textcoords="offset points", fontsize=8, color=mark.colour,
            va="bottom" if mark.raised else "center",
        )  # fmt: skip


@_draw.register(GuideLine)
def _(mark: GuideLine, axes: Axes, names: Mapping[str, Mapping[str, int]], layer: int, bars: Sequence[Bars]) -> Any:
    upright = mark.x is not None
    at: float = mark.x if mark.x is not None else mark.y or 0.0
    if mark.to is None:
        line: Any = {"color": mark.colour, "linewidth": mark.width * 0.8, "linestyle": DASHES[mark.dash], "zorder": 1}
        (axes.axvline if upright else axes.axhline)(at, **line)
    else:
        (axes.axvspan if upright else axes.axhspan)(at, mark.to, color=mark.colour, linewidth=0, zorder=0)
