"""Pictures of a screening as files: SVG for documents, PNG for mail and slides."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edp.data.screening import ScreeningResult
from edp.report.common.drawing import BLUE, DROPPED, INK, RULE, SOFT, file_name, write_drawings
from edp.report.common.wording import short_label
from edp.report.screening.views import (
    METRICS,
    UNITS,
    BarView,
    LagView,
    MatrixView,
    importance_views,
    lag_views,
    matrix_views,
    stability_views,
    value_views,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LINES = (BLUE, "#c9892f", "#5a9c8c", "#a97da0", "#8b929a", "#a5a04a", "#b9705c", "#3c4650")
DASHES = ("-", "--", ":", "-.")
SEQUENTIAL = ("#f7fafe", "#b7d0f7", "#6d9fec", "#2567d3", "#062c74")
DIVERGING = ("#7a4a06", "#d79a3c", "#ffffff", "#6d9fec", "#062c74")
_FIGURES_IN_CELLS = 32


def write_pictures(screening: ScreeningResult, folder: str | Path) -> list[Path]:
    """Write every picture as SVG and PNG: matrices, lag curves by target, stability, importance, linear value.

    Args:
        screening: the screening.
        folder: where to write; it is made.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    return write_drawings(folder, _drawings(screening))


def _drawings(screening: ScreeningResult) -> dict[str, Callable[[Figure], None]]:
    drawings: dict[str, Callable[[Figure], None]] = {}
    for matrix in matrix_views(screening):
        drawings[f"matrix_{matrix.measure}"] = partial(_matrix, view=matrix)
    for lag in lag_views(screening):
        drawings[f"lags_{file_name(lag.target)}"] = partial(_lags, view=lag, rate_hz=screening.rate_hz)
    for name, views in (
        *((f"stability_{metric}", _of(stability_views(screening), metric)) for metric in METRICS),
        ("importance", importance_views(screening)),
        ("value", value_views(screening)),
    ):
        if views:
            drawings[name] = partial(_bars, views=views)
    return drawings


def _of(views: Sequence[BarView], metric: str) -> tuple[BarView, ...]:
    return tuple(view for view in views if view.key == metric)


def _matrix(figure: Figure, view: MatrixView) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    count = len(view.names)
    size = min(max(0.3 * count + 2.0, 5.0), 22.0)
    figure.set_size_inches(size + 0.6, size)
    axes = figure.subplots()
    colours = LinearSegmentedColormap.from_list("edp", DIVERGING if view.signed else SEQUENTIAL)
    low = -view.top if view.signed else 0.0
    image = axes.imshow(np.ma.masked_invalid(view.values), cmap=colours, vmin=low, vmax=view.top)
    fine = 8 if count <= 60 else 5
    axes.set_xticks(range(count), view.names, rotation=60, ha="right", rotation_mode="anchor", fontsize=fine)
    axes.set_yticks(range(count), view.names, fontsize=fine)
    axes.tick_params(length=0)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    if count <= _FIGURES_IN_CELLS:
        for i, j in np.argwhere(np.isfinite(view.values)).tolist():
            value = float(view.values[i, j])
            strong = abs(value) > 0.55 * view.top
            axes.text(j, i, f"{value:.2f}".replace("-", "−"), ha="center", va="center", fontsize=5.5,
                      color="white" if strong else INK, in_layout=False)  # fmt: skip
    bar = figure.colorbar(image, ax=axes, fraction=0.03, pad=0.015)
    bar.outline.set_visible(False)
    bar.ax.set_title(view.unit, fontsize=8, color=SOFT)
    axes.set_title(view.title)


def _lags(figure: Figure, view: LagView, rate_hz: float) -> None:
    figure.set_size_inches(9.0, 5.0)
    axes = figure.subplots()
    axes.axvline(0, color="#c4cbd2", lw=0.8, ls=":")
    axes.axhline(0, color="#c4cbd2", lw=0.8)
    for k, curve in enumerate(view.curves):
        colour, dash = LINES[k % len(LINES)], DASHES[k // len(LINES) % len(DASHES)]
        label = f"{short_label(curve.channel)} ({curve.best:+d})".replace("-", "−")
        axes.plot(curve.lags, curve.correlation, color=colour, ls=dash, lw=1.8 if k == 0 else 1.2, label=label)
        axes.plot([curve.best], [curve.value], "o" if curve.certain else "x", color=colour, ms=4)
    axes.set_xlabel(f"Lag [samples of {1e3 / rate_hz:g} ms]; left: the channel leads")
    axes.set_ylabel("Cross-correlation")
    axes.set_xlim(float(view.curves[0].lags.min()), float(view.curves[0].lags.max()))
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8)
    axes.set_title(f"Lags against {short_label(view.target)}")


def _bars(figure: Figure, views: Sequence[BarView]) -> None:
    """A panel for each target side by side."""
    rows = max(len(view.bars) for view in views)
    figure.set_size_inches(max(4.2 * len(views), 7.0), 1.2 + 0.19 * rows)
    for axes, view in zip(np.atleast_1d(figure.subplots(1, len(views))), views):
        _panel(axes, view)
    unit = UNITS.get(views[0].key, "")
    figure.suptitle(f"{views[0].title}{f' [{unit}]' if unit else ''}", x=0.01, ha="left", fontsize=11, weight="bold")


def _panel(axes: Axes, view: BarView) -> None:
    places = np.arange(len(view.bars))
    values = np.array([bar.value for bar in view.bars])
    reach = np.array([[max(b.value - b.low, 0.0), max(b.high - b.value, 0.0)] for b in view.bars]).T
    errors: dict[str, Any] = {"ecolor": INK, "elinewidth": 0.8, "capsize": 1.5}
    colours = [BLUE if bar.proposed else DROPPED for bar in view.bars]
    axes.barh(places, values, 0.66, xerr=np.nan_to_num(reach), color=colours, error_kw=errors)
    marks = [(bar.mark, y) for bar, y in zip(view.bars, places) if math.isfinite(bar.mark)]
    if marks:
        axes.plot([m for m, _ in marks], [p for _, p in marks], "|", color=INK, ms=7, label="chance")
        axes.legend(frameon=False, fontsize=7, loc="lower right")
    axes.set_yticks(places, [bar.label for bar in view.bars], fontsize=7)
    axes.invert_yaxis()
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    axes.axvline(0, color="#c4cbd2", lw=0.8)
    more = f" (+ {view.more} more)" if view.more else ""
    title = "mean of all targets" if view.target == "all" else short_label(view.target)
    axes.set_title(title + more, fontsize=9, weight="normal")
