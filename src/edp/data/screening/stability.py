"""Check that a relation exists in every segment of the data and exceeds chance.

Chance is what a channel of one piece shows with the targets of another: both keep their own course, so that slow
signals, which go together now and then without any reason, are evaluated fairly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from edp.data.screening.compiled import spread
from edp.data.screening.information import Information
from edp.data.screening.lagged import Lagged
from edp.data.screening.linear import peaks
from edp.data.screening.ranks import Kendall, ranks_of
from edp.data.screening.result import Array, LagCurve, Stability
from edp.data.screening.spec import ScreeningSpec
from edp.data.screening.table import CandidateTable
from edp.recording import FloatArray

METRICS = ("pearson", "spearman", "kendall", "information")
_SHIFTS = 2
"""Other segments for the chance of a metric: each costs as much as all segments by themselves."""
_DRAWS = 200
"""Bootstrap draws for the interval of a lag, which is a whole number of samples."""


@dataclass(frozen=True, eq=False)
class Metrics:
    """Metrics of live channels at t and targets at t + horizon.

    Attributes:
        own: metrics of each segment, ``(metric, segment, channel, target)``.
        crossed: channels of a piece with targets of others, ``(metric, shift, segment, channel, target)``.
    """

    own: Array
    crossed: Array


def metrics_by_piece(
    table: CandidateTable, live: NDArray[np.int64], spec: ScreeningSpec, on_share: Callable[[float], None] | None = None
) -> Metrics:
    """Compute every metric in every segment, and between segments."""
    rows = [piece_rows(table, p, spec) for p in range(len(table.pieces))]
    count, shifts = len(rows), min(_SHIFTS, len(rows) - 1)

    def of_pair(pair: tuple[int, int]) -> Array:
        first, second = rows[pair[0]], rows[pair[1]]
        shared = min(len(first[0]), len(second[0]))
        return _metrics(first[0][:shared, live], second[1][:shared], spec)

    pairs = [(p, (p + shift) % count) for shift in range(shifts + 1) for p in range(count)]
    metrics = np.stack(spread(of_pair, pairs, on_share))
    metrics = metrics.reshape(shifts + 1, count, *metrics.shape[1:]).transpose(2, 0, 1, 3, 4)
    return Metrics(metrics[:, 0], metrics[:, 1:])


def piece_rows(table: CandidateTable, piece_index: int, spec: ScreeningSpec) -> tuple[FloatArray, FloatArray]:
    """Return evenly spaced rows of a segment: all channels at t, targets at t + horizon."""
    now, ahead = [], []
    piece = table.pieces[piece_index]
    for stretch in piece.stretches:
        usable = len(stretch) - spec.horizon
        if usable < 1:
            continue
        count = min(usable, max(1, spec.segment_samples * len(stretch) // piece.samples))
        row_indices = np.linspace(0, usable - 1, count).astype(np.int64)
        now.append(stretch[row_indices])
        ahead.append(stretch[row_indices + spec.horizon][:, table.targets])
    return np.concatenate(now), np.concatenate(ahead)


def _metrics(channels: FloatArray, targets: FloatArray, spec: ScreeningSpec) -> Array:
    """Return all metrics of all channels with all targets, ``(metric, channel, target)``; NaN where one is constant."""
    both = np.concatenate([channels, targets], axis=1)
    width, count = channels.shape[1], targets.shape[1]
    ranks = np.stack([ranks_of(both[:, i]) for i in range(both.shape[1])], axis=1)
    kendall, information = Kendall(both), Information(both, spec.neighbours, spec.seed)
    metrics = np.full((len(METRICS), width, count), np.nan)
    constant = both.max(axis=0) == both.min(axis=0)
    metrics[0], metrics[1] = _pearson(both, width), _pearson(ranks, width)
    for i in np.flatnonzero(~constant[:width]):
        for j in np.flatnonzero(~constant[width:]):
            metrics[2, i, j] = kendall.tau(int(i), width + int(j))
            metrics[3, i, j] = information.estimate(int(i), width + int(j))
    metrics[:, constant[:width]] = np.nan
    metrics[:, :, constant[width:]] = np.nan
    return metrics


def _pearson(values: FloatArray, width: int) -> Array:
    centred = values.astype(np.float64) - values.mean(axis=0, dtype=np.float64)
    deviation = np.sqrt(np.square(centred).sum(axis=0))
    scaled = centred / np.where(deviation > 0, deviation, 1.0)
    return np.asarray(scaled[:, :width].T @ scaled[:, width:])


def stability_of(names: Sequence[str], targets: Sequence[str], metrics: Metrics, lags: Array) -> list[Stability]:
    """Return one entry per metric, channel and target; `lags` are the best lags, ``(segment, channel, target)``."""
    own = np.concatenate([metrics.own, lags[None]])
    chance = np.concatenate([_mean(np.abs(metrics.crossed), (1, 2)), np.full((1, *lags.shape[1:]), np.nan)])
    stabilities = []
    for m, metric in enumerate((*METRICS, "lag")):
        for i, name in enumerate(names):
            for j, target in enumerate(targets):
                values = own[m, :, i, j]
                mean, deviation, agreement = _summary(values)
                stabilities.append(
                    Stability(metric, name, target, values, mean, deviation, agreement, float(chance[m, i, j]))
                )
    return stabilities


def _summary(values: Array) -> tuple[float, float, float]:
    """Return mean, deviation and the fraction with the sign of the mean; NaN without finite values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return math.nan, math.nan, math.nan
    mean = float(finite.mean())
    deviation = float(finite.std(ddof=1)) if len(finite) > 1 else math.nan
    return mean, deviation, float((np.sign(finite) == np.sign(mean)).mean())


def _mean(values: Array, axes: tuple[int, ...]) -> Array:
    """Return the mean of the finite values; NaN without finite values, without a warning."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axes)
    total = np.where(finite, values, 0.0).sum(axis=axes)
    result: Array = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return result


@dataclass(frozen=True, eq=False)
class Relations:
    """Whether live channels relate to targets, each array ``(channel, target)``.

    Attributes:
        linear: correlation at the best lag at which the channel is not later than the target, mean over the segments.
        linear_chance: largest linear relation between different segments.
        linear_t: mean over its standard error among the segments.
        information: mutual information at the horizon less that between segments, mean over the segments, nat.
        information_t: mean over its standard error.
        related: whether either is more than chance.
    """

    linear: Array
    linear_chance: Array
    linear_t: Array
    information: Array
    information_t: Array
    related: NDArray[np.bool_]


ABOVE_CHANCE = 1.5
"""A correlation counts from this multiple of the largest one between unrelated segments."""
MIN_INFORMATION = 0.02
"""Mutual information below this many nat is not worth a channel, however certain."""
MIN_CORRELATION = 0.03
"""The same for the correlation at the best lag."""
CLEARLY = 3.0
"""Times the largest correlation between unrelated segments at which a relation is clear."""


def relations_of(lagged: Lagged, places: NDArray[np.int64], metrics: Metrics, level: float) -> Relations:
    """Test every channel against every target.

    Args:
        lagged: covariances.
        places: indices of the targets among the channels.
        metrics: metrics by segment.
        level: chance of a false alarm, shared among all channels and targets.
    """
    until = lagged.reach + 1  # lags at which the channel is not later than the target
    pieces = lagged.by_piece(places)[:, :until]
    mean = pieces.mean(axis=0, dtype=np.float64)
    best = np.abs(mean).argmax(axis=0)
    linear = np.take_along_axis(mean, best[None], axis=0)[0]
    at_best = np.take_along_axis(pieces, best[None, None], axis=1)[:, 0].astype(np.float64)
    linear_t = _t(at_best)
    # the same largest mean between pieces, for each shift; all targets of a channel share their draws
    draws = np.abs(lagged.chance[:, :, :until].mean(axis=0, dtype=np.float64)).max(axis=1)
    chance = np.broadcast_to(draws.max(axis=(0, 2))[:, None], linear.shape)
    own, crossed = metrics.own[3], _mean(metrics.crossed[3], (0,))
    gain = own - crossed
    information, information_t = _mean(gain, (0,)), _t(gain)
    count = len(pieces)
    # The chance level between pieces guards the correlation already, as the largest of many draws over all lags; some
    # ten of them are independent.
    bound = float(stdtrit(count - 1, 1.0 - level / 20.0 / linear.shape[1]))
    bound_information = float(stdtrit(count - 1, 1.0 - level / linear.size))
    with np.errstate(invalid="ignore"):
        # Pieces of unlike manoeuvres differ so much that a real relation may be unsure among few of them: far above
        # all draws of chance, less will do.
        sure = (np.abs(linear) > ABOVE_CHANCE * chance) & (linear_t > bound)
        clear = (np.abs(linear) > CLEARLY * chance) & (linear_t > float(stdtrit(count - 1, 0.995)))
        by_lag = (np.abs(linear) > MIN_CORRELATION) & (sure | clear)
        by_information = (information > MIN_INFORMATION) & (information_t > bound_information)
    return Relations(linear, chance.copy(), linear_t, information, information_t, by_lag | by_information)


def _t(values: Array) -> Array:
    """Return the absolute mean over its standard error among segments, ``(segment, ...)`` to ``(...)``.

    NaN counts as 0.
    """
    values = np.nan_to_num(values)
    error = values.std(axis=0, ddof=1) / math.sqrt(len(values))
    # Equal values in all pieces are as sure as can be, not a division by zero.
    result: Array = np.abs(values.mean(axis=0)) / np.maximum(error, 1e-12)
    return result


def lag_curves(
    table: CandidateTable, lagged: Lagged, names: Sequence[str], targets: Sequence[str], spec: ScreeningSpec
) -> tuple[list[LagCurve], Array]:
    """Return the lag curve of every channel and target, and the best lag per segment, ``(segment, channel, target)``.

    The interval comes from segments drawn again and again with replacement.
    """
    places = np.searchsorted(lagged.live, table.targets)
    pooled = lagged.pooled()[:, :, places]
    pieces = lagged.by_piece(places)
    best, value = peaks(pooled, -lagged.reach, lagged.reach)
    of_piece = np.abs(pieces).argmax(axis=1) - lagged.reach
    rng = np.random.default_rng(spec.seed)
    weights = rng.multinomial(len(pieces), np.full(len(pieces), 1.0 / len(pieces)), size=_DRAWS).astype(np.float32)
    sums = lagged.sums[:, :, :, places]
    low, high = np.empty(best.shape), np.empty(best.shape)
    for j in range(len(targets)):
        drawn = np.abs(np.tensordot(weights, sums[:, :, :, j], axes=1)).argmax(axis=1) - lagged.reach
        low[:, j], high[:, j] = np.quantile(drawn, (0.025, 0.975), axis=0)
    chance = np.abs(lagged.chance.mean(axis=0, dtype=np.float64)).max(axis=1).max(axis=(0, 2))
    curves = []
    for i, name in enumerate(names):
        for j, target in enumerate(targets):
            at_best = pieces[:, best[i, j] + lagged.reach, i, j]
            agreement = float((np.sign(at_best) == np.sign(value[i, j])).mean())
            curves.append(
                LagCurve(
                    name,
                    target,
                    table.groups[table.names.index(name)],
                    lagged.lags,
                    pooled[:, i, j],
                    int(best[i, j]),
                    float(value[i, j]),
                    float(low[i, j]),
                    float(high[i, j]),
                    agreement,
                    bool(agreement >= 0.8 and abs(value[i, j]) > ABOVE_CHANCE * chance[i]),
                    bool(abs(best[i, j]) == lagged.reach),
                )
            )
    return curves, of_piece.astype(np.float64)
