"""Pictures of a study as files: SVG for documents, PNG for mail and slides."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edp.report.common.drawing import BLUE, DROPPED, INK, RULE, SOFT, file_name, write_drawings
from edp.report.search.facts import StudyFacts
from edp.report.search.plots import SHADES, TICKS, arm_caption, outside, short, spread_over, tests_of
from edp.report.search.views import (
    COSTS,
    ArmView,
    Forest,
    PhaseTrack,
    PointView,
    arm_views,
    forests,
    front,
    point_views,
    top_of,
    tracks,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = ("D", "s", "^", "X", "P", "*", "o", "v")


def write_study_pictures(study: StudyFacts, folder: str | Path) -> list[Path]:
    """Write every picture that there are facts for: variance, Pareto front by cost, effects by phase, history.

    Args:
        study: the study.
        folder: where to write; it is made.

    Returns:
        the files, in order.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    return write_drawings(folder, drawings(study))


def drawings(study: StudyFacts) -> dict[str, Callable[[Figure], None]]:
    """What draws each picture, by the name of its file."""
    drawings: dict[str, Callable[[Figure], None]] = {}
    arms, points, history = arm_views(study), point_views(study), tracks(study)
    if arms:
        drawings["variance"] = partial(_variance, arms=arms, unit=study.unit)
    for cost in COSTS:
        if any(cost in point.costs for point in points):
            drawings[f"pareto_{cost}"] = partial(_pareto, points=points, cost=cost, unit=study.unit)
    for forest in forests(study):
        drawings[f"effects_{file_name(forest.key)}"] = partial(_forest, view=forest)
    if top_of(score for view in history for score in view.scores) is not None:
        drawings["history"] = partial(_history, views=history, unit=study.unit)
    return drawings


def _variance(figure: Figure, arms: Sequence[ArmView], unit: str) -> None:
    figure.set_size_inches(max(1.5 * len(arms) + 1.2, 5.0), 4.4)
    axes = figure.subplots()
    named: set[bool] = set()
    for x_centre, arm in enumerate(arms):
        colour = BLUE if arm.chosen else SHADES[0]
        x = spread_over(x_centre, len(arm.scores))
        axes.hlines(arm.composite.mean, x_centre - 0.42, x_centre + 0.42, color=INK, lw=1.4, zorder=1)
        for spot, seeds in zip(x, arm.scores):
            axes.plot([spot] * len(seeds), seeds, "-o", color=colour, lw=0.8, ms=2, alpha=0.6)
        label = None if arm.chosen in named else arm.features
        means = [float(np.mean(seeds)) for seeds in arm.scores]
        axes.plot(x, means, "o" if arm.chosen else "D", color=colour, ms=4.5, label=label)
        named.add(arm.chosen)
    axes.set_xticks(range(len(arms)), ["\n".join(arm_caption(arm)) for arm in arms], fontsize=8)
    axes.tick_params(axis="x", length=0)
    axes.set_ylabel(f"Composite score [{unit}]")
    axes.grid(axis="y", color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    axes.set_title("Between runs and seeds")


def _pareto(figure: Figure, points: Sequence[PointView], cost: str, unit: str) -> None:
    figure.set_size_inches(7.6, 4.8)
    axes = figure.subplots()
    best = front(points, cost)
    for index, group in enumerate(dict.fromkeys(point.group for point in points)):
        own = [point for point in points if point.group == group and cost in point.costs]
        axes.scatter(
            [p.costs[cost] for p in own], [p.score for p in own], s=[46 if p in best or p.picked else 22 for p in own],
            marker=MARKERS[index % len(MARKERS)], color=SHADES[index % len(SHADES)], label=group, zorder=2,
            edgecolors=[BLUE if p in best else "none" for p in own], linewidths=1.3,
        )  # fmt: skip
    axes.step([p.costs[cost] for p in best], [p.score for p in best], where="post", color=BLUE, lw=1.6, zorder=1,
              label="Pareto front")  # fmt: skip
    for point in points:
        if point.picked and cost in point.costs:
            at = (point.costs[cost], point.score)
            axes.annotate(point.picked, at, (4, 5), textcoords="offset points", ha="left", fontsize=7.5, color=INK)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = [tick for tick in TICKS if low <= tick <= high]
    axes.set_xticks(ticks, [short(tick) for tick in ticks])  # the scale's own labels are formulas
    axes.minorticks_off()
    _score_axis(axes, [point.score for point in points], unit)
    axes.set_xlabel(COSTS[cost])
    axes.grid(color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set_title("Score against cost")


def _score_axis(axes: Axes, scores: Sequence[float], unit: str) -> float:
    """Limits that show nearly all; the upper end."""
    low, top = min(score for score in scores if math.isfinite(score)), top_of(scores) or 1.0
    axes.set_ylim(low - 0.08 * (top - low), top)
    axes.set_ylabel(f"Composite score [{unit}]")
    return top


def _forest(figure: Figure, view: Forest) -> None:
    figure.set_size_inches(8.6, 1.4 + 0.3 * len(view.effects))
    axes = figure.subplots()
    axes.axvline(0, color=INK, lw=0.8)
    if view.gate is not None:
        axes.axvline(view.gate, color=SOFT, lw=0.9, ls=":")
    for y, effect in enumerate(view.effects):
        colour = BLUE if effect.good else DROPPED
        if effect.low is not None and effect.high is not None:
            axes.plot([effect.low, effect.high], [y, y], "-|", color=BLUE if effect.good else SOFT, lw=1.3, ms=6)
        axes.plot([effect.value], [y], "s" if effect.good else "o", color=colour, ms=6)
        axes.annotate(tests_of(effect), (1.02, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
    axes.set_yticks(range(len(view.effects)), [effect.module for effect in view.effects], fontsize=8)
    axes.set_ylim(len(view.effects) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color=RULE, lw=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel(view.axis)
    axes.set_title(view.title)


def _history(figure: Figure, views: Sequence[PhaseTrack], unit: str) -> None:
    figure.set_size_inches(9.0, 4.4)
    axes = figure.subplots()
    top = _score_axis(axes, [score for view in views for score in view.scores], unit)
    for index, view in enumerate(views):
        axes.plot(view.places, view.scores, "o", color=SHADES[index % len(SHADES)], ms=3, label=view.heading)
        axes.step(view.places, view.best, where="post", color=BLUE, lw=1.4)
        if index:
            axes.axvline(view.places[0] - 0.5, color=RULE, lw=1)
    above, pruned, failed = outside(views, top)
    for marks, symbol, word in ((above, "^", "above the scale"), (pruned, "_", "pruned"), (failed, "x", "failed")):
        if marks:
            axes.plot(
                [index for index, _ in marks], [top] * len(marks), symbol, color=SOFT, ms=4, label=word, clip_on=False
            )
    axes.set_xlabel("Training")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set_title("Search history; steps: best of the phase so far")
