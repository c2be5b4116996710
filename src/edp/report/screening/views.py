"""Data of a screening's figures as plain arrays; `charts` gives their look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edp.wording import short_labels

if TYPE_CHECKING:
    from edp.data.screening import GroupImportance, LagCurve, ScreeningResult, Stability, Value

Array = NDArray[np.float64]
MEASURES = {
    "spearman": "Spearman rank correlation",
    "information": "Mutual information",
    "pearson": "Pearson correlation",
    "kendall": "Kendall rank correlation",
}
"""Measures of dependence. The two measures shown in the thesis come first."""
METRICS = {**MEASURES, "lag": "Best lag"}
UNITS = {"information": "nat", "lag": "samples"}
MAX_CURVES = 16
MAX_BARS = 40


@dataclass(frozen=True, eq=False)
class MatrixView:
    """One matrix of dependencies.

    Attributes:
        measure: key of `MEASURES`.
        title: title in words.
        unit: unit of the entries, empty for a correlation.
        names: names of rows and columns.
        values: shape ``(channel, channel)``; NaN is left white.
        top: largest magnitude of the colours.
        signed: whether colours run from -top to top.
    """

    measure: str
    title: str
    unit: str
    names: tuple[str, ...]
    values: Array
    top: float
    signed: bool


@dataclass(frozen=True, eq=False)
class LagView:
    """Lag curves of the channels that go best with a target, the best first."""

    target: str
    curves: tuple[LagCurve, ...]


@dataclass(frozen=True)
class Bar:
    """One bar with its interval; `mark` is a value to compare it with (chance), NaN without one."""

    label: str
    value: float
    low: float
    high: float
    mark: float = math.nan
    proposed: bool = False


@dataclass(frozen=True)
class BarView:
    """Bars of one picture, the largest first, and how many more there are."""

    key: str
    target: str
    title: str
    bars: tuple[Bar, ...]
    more: int


@dataclass(frozen=True)
class LagRangeView:
    """A row of Table 4.2's form: where the best lags of a kind of signal lie, over channels whose lag is certain.

    Attributes:
        group: kind of signal.
        low, high: smallest and largest best lag, None where none is certain.
        median: median of the best lags.
        leads: share of these channels that lead.
        certain: number of channels with a certain lag.
        curves: number of channels.
    """

    group: str
    low: int | None
    high: int | None
    median: float | None
    leads: float | None
    certain: int
    curves: int


def matrix_views(screening: ScreeningResult) -> tuple[MatrixView, ...]:
    """Return the four matrices; mutual information has no diagonal and colours up to its 99.5 % quantile."""
    views = []
    for measure, title in MEASURES.items():
        values = np.array(getattr(screening.matrices, measure), dtype=float)
        signed = measure != "information"
        top = 1.0
        if not signed:
            np.fill_diagonal(values, np.nan)
            good = values[np.isfinite(values)]
            top = max(float(np.quantile(good, 0.995)), 1e-3) if len(good) else 1.0
        names = short_labels(screening.matrices.names)
        views.append(MatrixView(measure, title, UNITS.get(measure, ""), names, values, top, signed))
    return tuple(views)


def lag_views(screening: ScreeningResult) -> tuple[LagView, ...]:
    """Return the curves of the channels that correlate best with each target, without the target itself."""
    views = []
    for target in screening.targets:
        curves = [c for c in screening.lags if c.target == target and c.channel != target and math.isfinite(c.value)]
        best = sorted(curves, key=lambda curve: -abs(curve.value))[:MAX_CURVES]
        if best:
            views.append(LagView(target, tuple(best)))
    return tuple(views)


def lag_ranges(screening: ScreeningResult, within: Sequence[str] | None = None) -> tuple[LagRangeView, ...]:
    """Return the ranges of the best lags by kind of signal, in the form of Table 4.2.

    Each channel counts once, against the target that it goes best with, itself left out; and it counts where that lag
    is certain and inside the search.

    Args:
        screening: the screening.
        within: channels to include; None takes all without a flag.
    """
    flagged = {flag.channel for flag in screening.flags}
    names = [name for name in screening.channels if name not in flagged] if within is None else list(within)
    ranges = []
    for group in dict.fromkeys(screening.groups):
        members = {name for name, own in zip(screening.channels, screening.groups) if own == group} & set(names)
        curves = [curve for name in names if name in members and (curve := _strongest(screening, name)) is not None]
        certain = [curve.best for curve in curves if curve.certain and not curve.at_edge]
        if not curves:
            continue
        if certain:
            leads = float(np.mean(np.array(certain) < 0))
            row = LagRangeView(
                group, min(certain), max(certain), float(np.median(certain)), leads, len(certain), len(curves)
            )
        else:
            row = LagRangeView(group, None, None, None, None, 0, len(curves))
        ranges.append(row)
    return tuple(ranges)


def _strongest(screening: ScreeningResult, channel: str) -> LagCurve | None:
    """Return the curve of a channel against its most dependent target."""
    curves = [c for c in screening.lags if c.channel == channel != c.target and math.isfinite(c.value)]
    return max(curves, key=lambda curve: abs(curve.value), default=None)


def stability_views(screening: ScreeningResult) -> tuple[BarView, ...]:
    """Return for each metric and target the channels with the largest mean over segments; bars span one deviation."""
    views = []
    for metric, title in METRICS.items():
        for target in screening.targets:
            entries = [
                entry
                for entry in screening.stability
                if entry.metric == metric
                and entry.target == target
                and entry.channel != target
                and math.isfinite(entry.mean)
            ]
            if entries:
                views.append(_stability(screening, metric, target, title, entries))
    return tuple(views)


def _stability(
    screening: ScreeningResult, metric: str, target: str, title: str, entries: Sequence[Stability]
) -> BarView:
    proposed = set(screening.proposal.kept)
    ranked = sorted(entries, key=lambda entry: -abs(entry.mean))
    bars = tuple(
        Bar(
            e.channel,
            e.mean,
            e.mean - e.deviation,
            e.mean + e.deviation,
            math.copysign(e.chance, e.mean),  # chance is a size; it stands on the bar's side
            e.channel in proposed,
        )
        for e in ranked[:MAX_BARS]
    )
    return BarView(metric, target, title, _make_labels_unique(bars), max(0, len(ranked) - MAX_BARS))


def _make_labels_unique(bars: Sequence[Bar]) -> tuple[Bar, ...]:
    """Return the bars under short labels, each its own."""
    labels = short_labels(bar.label for bar in bars)
    return tuple(replace(bar, label=label) for bar, label in zip(bars, labels, strict=True))


def importance_views(screening: ScreeningResult) -> tuple[BarView, ...]:
    """Return the permutation importance by target, the mean of all first."""
    proposed = set(screening.proposal.kept)
    views = []
    for target in ("all", *screening.targets):
        entries = [entry for entry in screening.importance if entry.target == target]
        ranked = sorted(entries, key=lambda entry: -entry.increase)
        bars = tuple(
            Bar(joined(e.members), e.increase, e.low, e.high, proposed=bool(proposed & set(e.members)))
            for e in ranked[:MAX_BARS]
        )
        if bars:
            views.append(
                BarView(
                    "importance",
                    target,
                    "Permutation importance",
                    _make_labels_unique(bars),
                    max(0, len(ranked) - MAX_BARS),
                )
            )
    return tuple(views)


def value_views(screening: ScreeningResult) -> tuple[BarView, ...]:
    """Return the information that each channel's past adds to the pasts of all others, by target."""
    proposed = set(screening.proposal.kept)
    views = []
    for target in screening.targets:
        entries: list[Value] = [entry for entry in screening.values if entry.target == target]
        ranked = sorted(entries, key=lambda entry: -entry.gain)
        bars = tuple(Bar(e.channel, e.gain, e.low, e.high, proposed=e.channel in proposed) for e in ranked[:MAX_BARS])
        if bars:
            views.append(
                BarView("value", target, "Linear value", _make_labels_unique(bars), max(0, len(ranked) - MAX_BARS))
            )
    return tuple(views)


def joined(members: Sequence[str]) -> str:
    """Return a group's name from its first members."""
    shown = ", ".join(short_labels(members)[:3])
    return shown if len(members) <= 3 else f"{shown} + {len(members) - 3}"


def best_groups(screening: ScreeningResult, count: int = 3) -> tuple[GroupImportance, ...]:
    """Return the groups with the largest mean importance."""
    entries = [entry for entry in screening.importance if entry.target == "all"]
    return tuple(sorted(entries, key=lambda entry: -entry.increase)[:count])
