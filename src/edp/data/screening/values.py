"""Granger gain: improvement by the past of a channel in a linear prediction from all other pasts, on left-out segments.

The models are solved and evaluated on lagged covariances alone. Leaving a channel out of a solved model costs one small
system, so that every channel is left out in turn and the rest solved again, exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.special import stdtrit

from edp.data.screening.compiled import spread
from edp.data.screening.lagged import Lagged
from edp.data.screening.linear import RIDGE, Tap, gram
from edp.data.screening.result import Array, Value

HISTORY = (0, 1, 2, 4, 8, 16, 32)
"""Delays of each channel, samples."""
WINDOWS = (5, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 300, 400, 500)
"""History lengths that are tried, in samples."""
ENOUGH = 0.02
"""Maximum relative difference between the held-out error of a sufficient window and the best held-out error."""


def choose_held_out(count: int, share: float, seed: int) -> NDArray[np.int64]:
    """Choose the left-out segments: at least two, at most all but two."""
    # At least two on either side are needed to estimate the spread.
    piece_count = min(max(2, round(count * share)), count - 2)
    return np.sort(np.random.default_rng(seed).permutation(count)[:piece_count])


def _correlations(lagged: Lagged, pieces: NDArray[np.int64]) -> Array:
    """Return the mean product over the given segments, ``(lag, channel, channel)``: about 1 on the diagonal."""
    result: Array = lagged.sums[pieces].sum(axis=0, dtype=np.float64) / lagged.samples[pieces].sum()
    return result


class _Model:
    """Linear predictor of the target's change, fitted on the training segments and evaluated on the others."""

    def __init__(self, train: Array, taps: Sequence[Tap], target: int, ahead: int) -> None:
        self.taps, self.target, self.ahead = list(taps), target, ahead
        self.moments = gram(train, taps, taps)
        self.moments[np.diag_indices(len(taps))] += RIDGE
        self.answers = self.answers_of(train)
        self.factor = scipy.linalg.cho_factor(self.moments, lower=True, check_finite=False)
        self.weights = scipy.linalg.cho_solve(self.factor, self.answers, check_finite=False)

    def answers_of(self, sums: Array) -> Array:
        """Return the products of the regressors with ``y[t + ahead] - y[t]`` (with ``y[t]`` itself for 0 ahead)."""
        ahead = gram(sums, self.taps, [(self.target, -self.ahead)])[:, 0]
        return ahead if self.ahead == 0 else ahead - gram(sums, self.taps, [(self.target, 0)])[:, 0]

    def power(self, sums: Array) -> float:
        """Return the mean square of the predicted quantity."""
        reach = len(sums) // 2
        now = sums[reach, self.target, self.target]
        return float(now if self.ahead == 0 else 2.0 * (now - sums[reach + self.ahead, self.target, self.target]))

    def without(self, columns: NDArray[np.int64]) -> Array:
        """Return the weights after removing some regressors and solving again; removed weights are zero."""
        unit = np.zeros((len(self.taps), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        inverse = scipy.linalg.cho_solve(self.factor, unit, check_finite=False)
        # Solution without some regressors from the whole one, by the block inverse: no second factorisation.
        change = np.linalg.solve(inverse[columns], self.weights[columns])
        weights = self.weights - inverse @ change
        weights[columns] = 0.0
        return np.asarray(weights)

    def error(self, weights: Array, moments: Array, answers: Array, power: float) -> float:
        """Return the mean squared error on data with these sums."""
        # Rounding can leave a perfect fit below zero.
        return max(float(power - 2.0 * weights @ answers + weights @ (moments @ weights)), 1e-12)


def linear_values(
    names: Sequence[str],
    lagged: Lagged,
    used: Sequence[int],
    targets: Sequence[int],
    horizon: int,
    held_out: NDArray[np.int64],
    on_share: Callable[[float], None] | None = None,
) -> list[Value]:
    """Return the Granger gain of each used channel for each target.

    Args:
        names: names of the channels of `lagged`.
        lagged: lagged covariances of every segment.
        used: columns that a model may read; targets too, unless the horizon is 0.
        targets: columns of the targets.
        horizon: samples ahead.
        held_out: segments that evaluate; the others train.
        on_share: callback with the completed fraction.
    """
    train = _correlations(lagged, np.setdiff1d(np.arange(len(lagged.samples)), held_out))
    read = [k for k in used if horizon > 0 or k not in targets]
    delays = [a for a in HISTORY if a + horizon <= lagged.reach]
    taps = [(k, a) for k in read for a in delays]
    judged = [_correlations(lagged, np.array([p])) for p in held_out]
    moments = [gram(sums, taps, taps) for sums in judged]
    values: list[Value] = []
    for done, target in enumerate(targets):
        model = _Model(train, taps, target, horizon)
        judge_moments = [(m, model.answers_of(s), model.power(s)) for m, s in zip(moments, judged, strict=True)]
        whole = np.array([model.error(model.weights, *k) for k in judge_moments])

        def of_channel(
            read_index: int,
            model: _Model = model,
            channel_moments: list[tuple[Array, Array, float]] = judge_moments,
            whole: Array = whole,
        ) -> tuple[float, float, float]:
            columns = np.arange(read_index * len(delays), (read_index + 1) * len(delays))
            weights = model.without(columns)
            less = np.array([model.error(weights, *k) for k in channel_moments])
            return _interval(1.0 - whole / less, float(1.0 - whole.sum() / less.sum()))

        for channel_index, (gain, low, high) in enumerate(spread(of_channel, range(len(read)))):
            values.append(Value(names[read[channel_index]], names[target], gain, low, high))
        if on_share is not None:
            on_share((done + 1) / len(targets))
    return values


def _interval(values: Array, middle: float) -> tuple[float, float, float]:
    """Return the pooled value with a 95 % t interval from the segments."""
    error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    half = float(stdtrit(max(len(values) - 1, 1), 0.975) * error)
    return middle, middle - half, middle + half


def window_needed(
    lagged: Lagged, used: Sequence[int], targets: Sequence[int], horizon: int, held_out: NDArray[np.int64]
) -> tuple[int, dict[int, float]]:
    """Return the shortest history for which a linear prediction is about as good as for the longest history evaluated.

    Args:
        lagged: lagged covariances of every segment.
        used: columns that a model may read.
        targets: columns of the targets.
        horizon: samples ahead.
        held_out: segments for evaluation.

    Returns:
        The window in samples, and the held-out error of each tried window as a fraction of the change's variance.
    """
    train = _correlations(lagged, np.setdiff1d(np.arange(len(lagged.samples)), held_out))
    judge = _correlations(lagged, held_out)
    read = [k for k in used if horizon > 0 or k not in targets]
    longest = lagged.reach - horizon + 1
    windows = [w for w in WINDOWS if w <= longest] or [longest]

    def of_window(window: int) -> float:
        # Nine delays on a logarithmic scale: dense where signals change, and few for a long window.
        delays = sorted({round(d) for d in np.geomspace(1, window, 9)} | {1, 2})
        taps = [(k, d - 1) for k in read for d in delays]
        shares = []
        for target in targets:
            model = _Model(train, taps, target, horizon)
            error = model.error(model.weights, gram(judge, taps, taps), model.answers_of(judge), model.power(judge))
            shares.append(error / model.power(judge))
        return float(np.mean(shares))

    errors = dict(zip(windows, spread(of_window, windows)))
    best = min(errors.values())
    return next(w for w in windows if errors[w] <= (1.0 + ENOUGH) * best), errors
