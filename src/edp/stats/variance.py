"""Variance components of scores: between splits, between seeds, and, for differences, between sessions and runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from edp.errors import DataError
from edp.stats.checks import check_tested_cells, finite


@dataclass(frozen=True)
class SplitVariance:
    """Mean score and its standard deviations between splits and between seeds within a split.

    Attributes:
        mean: mean score over all runs.
        split: standard deviation between splits.
        seed: standard deviation between seeds; None with one seed.
        split_interval, seed_interval: 95 % intervals; None where they are not defined.
    """

    mean: float
    split: float
    seed: float | None
    split_interval: tuple[float, float] | None = None
    seed_interval: tuple[float, float] | None = None


def thesis_variance(scores: ArrayLike) -> SplitVariance:
    """Return the variances of eq. 2.17 and 2.18 of the thesis.

    The first also contains a part of the seed variance. The second is a mean of standard deviations and is biased low
    by c4(S), 0.886 for three seeds. `split_variance` avoids both errors.

    Args:
        scores: ``(split, seed)``.

    Raises:
        DataError: fewer than two splits or values that are not finite.
    """
    array = _check_scores(scores)
    seed = float(array.std(axis=1, ddof=1).mean()) if array.shape[1] > 1 else None
    return SplitVariance(float(array.mean()), float(array.mean(axis=1).std(ddof=1)), seed)


def split_variance(scores: ArrayLike, level: float = 0.95) -> SplitVariance:
    """Return the variance components of one arm by analysis of variance, with intervals.

    The seed variance is pooled over the splits, its interval exact for normal scores. The split variance is the
    variance of the split means less their share of the seeds'; its interval is Graybill and Wang's (1980). With
    one seed the two cannot be distinguished: `split` holds both.

    Args:
        scores: ``(split, seed)``.
        level: confidence level of the intervals.

    Raises:
        DataError: fewer than two splits or values that are not finite.
    """
    array = _check_scores(scores)
    splits, seeds = array.shape
    mean, tail = float(array.mean()), 0.5 - 0.5 * level
    between = seeds * float(array.mean(axis=1).var(ddof=1))
    df1 = splits - 1
    # Both variances are one figure then, and its interval the usual one of a variance.
    if seeds == 1:
        bounds = [float(np.sqrt(df1 * between / chdtri(df1, p))) for p in (tail, 1.0 - tail)]
        return SplitVariance(mean, float(np.sqrt(between)), None, (bounds[0], bounds[1]))
    df2 = splits * (seeds - 1)
    within = float(array.var(axis=1, ddof=1).mean())
    low, high = _difference_interval(_MeanSquare(between, df1), _MeanSquare(within, df2), tail)
    seed = [float(np.sqrt(df2 * within / chdtri(df2, p))) for p in (tail, 1.0 - tail)]
    return SplitVariance(
        mean,
        float(np.sqrt(max(between - within, 0.0) / seeds)),
        float(np.sqrt(within)),
        (float(np.sqrt(max(low, 0.0) / seeds)), float(np.sqrt(max(high, 0.0) / seeds))),
        (seed[0], seed[1]),
    )


@dataclass(frozen=True)
class _MeanSquare:
    """A mean square with its degrees of freedom."""

    value: float
    freedom: int


def _difference_interval(first: _MeanSquare, second: _MeanSquare, tail: float) -> tuple[float, float]:
    """Return the interval for the difference of two expected mean squares."""
    from scipy.stats import f as f_distribution  # late: see edp.stats.effects

    between, df1, within, df2 = first.value, first.freedom, second.value, second.freedom
    g1, h1 = 1.0 - df1 / chdtri(df1, tail), df1 / chdtri(df1, 1.0 - tail) - 1.0
    g2, h2 = 1.0 - df2 / chdtri(df2, tail), df2 / chdtri(df2, 1.0 - tail) - 1.0
    upper, lower = (float(f_distribution.isf(p, df1, df2)) for p in (tail, 1.0 - tail))
    g12 = ((upper - 1.0) ** 2 - (g1 * upper) ** 2 - h2**2) / upper
    h12 = ((1.0 - lower) ** 2 - (h1 * lower) ** 2 - g2**2) / lower
    down = (g1 * between) ** 2 + (h2 * within) ** 2 + g12 * between * within
    up = (h1 * between) ** 2 + (g2 * within) ** 2 + h12 * between * within
    return between - within - np.sqrt(max(down, 0.0)), between - within + np.sqrt(max(up, 0.0))


def seed_correlation(module: ArrayLike, baseline: ArrayLike) -> float:
    """Return the correlation of two arms over the seeds of a split: the benefit of common random values.

    The variance of a paired difference is ``2 s^2 (1 - rho)``, not ``2 s^2``.

    Args:
        module: ``(split, seed)``, the same seeds in both.
        baseline: scores of the baseline, same shape.

    Raises:
        DataError: one seed, unequal shapes, values that are not finite, or an arm without spread.
    """
    first, second = _check_scores(module), _check_scores(baseline)
    if first.shape != second.shape or first.shape[1] < 2:
        raise DataError(f"tables of shape {first.shape} and {second.shape} came; give equal ones of at least two seeds")
    first, second = (table - table.mean(axis=1, keepdims=True) for table in (first, second))
    scale = float(np.sqrt(np.square(first).sum() * np.square(second).sum()))
    if scale == 0.0:
        raise DataError("the seeds of an arm do not differ, so they have no correlation; check that seeds are used")
    return float((first * second).sum() / scale)


@dataclass(frozen=True)
class PairedVariance:
    """Variances of the paired differences of two arms, in the squared unit of the scores.

    Attributes:
        session: variance of the module's effect between sessions, sigma_h^2, which more runs do not reduce.
        run: variance of the effect between training runs, from splits and seeds: sigma_f^2 + 2 sigma_s^2 (1 - rho).
        cell: residual variance of each cell of a run and a session.
    """

    session: float
    run: float
    cell: float = 0.0

    def compute_mean_variance(self, sessions: int, runs: float, cells_per_run: float) -> float:
        """Return the variance of the mean difference: ``sigma_h^2 / R + (run + cell / cells) / n_runs``."""
        return self.session / sessions + (self.run + self.cell / cells_per_run) / runs


def paired_variance(differences: ArrayLike, tested: ArrayLike | None = None) -> PairedVariance:
    """Estimate the variances by the method of moments (Henderson's first method), limited to at least zero.

    Args:
        differences: ``(run, session)``, module minus baseline.
        tested: ``(run, session)``; None: all. Some sessions must be tested by more than one run, and some runs on
            more than one session; else a session's variance and a cell's cannot be distinguished.

    Raises:
        DataError: the cells cannot tell the variances apart, or hold values that are not finite.
    """
    array, mask = check_tested_cells(differences, tested)
    if array.ndim != 2:
        raise DataError(f"the differences have shape {array.shape}; give (run, session)")
    per_run, per_session, cells = mask.sum(axis=1), mask.sum(axis=0), int(mask.sum())
    runs, sessions = mask.shape
    # The part of all sums of squares that the mean takes.
    level = float(array.sum()) ** 2 / cells
    sums = np.array(
        [
            float((array.sum(axis=0) ** 2 / per_session).sum()) - level,
            float((array.sum(axis=1) ** 2 / per_run).sum()) - level,
            float(np.square(array).sum()) - level,
        ]
    )
    session_pairs, run_pairs = (float(np.square(n).sum()) / cells for n in (per_session, per_run))
    expected = np.array(
        [
            [cells - session_pairs, sessions - run_pairs, sessions - 1.0],
            [runs - session_pairs, cells - run_pairs, runs - 1.0],
            [cells - session_pairs, cells - run_pairs, cells - 1.0],
        ]
    )
    # The three sums are then nearly proportional, and the solution would be noise.
    if np.linalg.cond(expected) > 1e8:
        raise DataError(
            f"{runs} runs on {sessions} sessions with {cells} cells cannot tell sessions, runs and cells apart; "
            "repeat the folds with another partition"
        )
    session, run, cell = (max(float(value), 0.0) for value in np.linalg.solve(expected, sums))
    return PairedVariance(session, run, cell)


def _check_scores(scores: ArrayLike) -> np.ndarray:
    array = finite(scores, "table of scores", 2)
    if array.ndim != 2 or array.shape[0] < 2:
        raise DataError(f"the scores have shape {array.shape}; give (split, seed) with at least two splits")
    return array
