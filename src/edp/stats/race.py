"""Races: unpromising modules are dropped early, which lowers the power but not the significance level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp.errors import ConfigError
from edp.stats.checks import Array, check_tested_mask
from edp.stats.clustered import clustered_t
from edp.stats.power import simulate_differences
from edp.stats.variance import PairedVariance


@dataclass(frozen=True)
class InterimAnalysis:
    """Interim analysis of the data until now.

    Attributes:
        runs: number of runs after which the analysis takes place.
        drop_above: a module with a larger one-sided p-value is dropped.
    """

    runs: int
    drop_above: float


INTERIM_ANALYSES = (InterimAnalysis(5, 0.35), InterimAnalysis(10, 0.15), InterimAnalysis(15, 0.08))
"""Interim analyses after one, two and three repeats of five folds."""


@dataclass(frozen=True, eq=False)
class RaceResult:
    """Result of a race for each module; arrays over the leading axes of the differences.

    Attributes:
        dropped_after: number of runs after which the module was dropped; 0 if it completed all runs.
        runs: number of runs until the decision.
        p: one-sided p-value over all runs; 1 if the module was dropped.
    """

    dropped_after: NDArray[np.int64]
    runs: NDArray[np.int64]
    p: Array


def race(
    differences: ArrayLike,
    tested: ArrayLike | None = None,
    interim_analyses: Sequence[InterimAnalysis] = INTERIM_ANALYSES,
) -> RaceResult:
    """Perform the interim analyses, then test the remaining modules over all runs.

    They can only stop for futility. A module that none of them dropped is evaluated by the same test as without them,
    so under the null the probability of confirming it can only fall: futility analyses spend no alpha.

    Args:
        differences: ``(..., run, session)`` in the order of the runs; values after the analysis that drops a module are
            not used.
        tested: ``(run, session)``; None: all.
        interim_analyses: numbers of runs in ascending order; analyses at or beyond the total number of runs are
            omitted.

    Raises:
        ConfigError: analyses out of order, before the second run, or with levels outside 0 to 1.
        DataError: see `clustered_t`.
    """
    _check(interim_analyses)
    array = np.asarray(differences, dtype=np.float64)
    mask = check_tested_mask(tested, array.shape)
    dropped = np.zeros(array.shape[:-2], dtype=np.int64)
    for analysis in interim_analyses:
        # An analysis after the last run would be the final test itself.
        if analysis.runs < mask.shape[0]:
            hopeless = clustered_t(array[..., : analysis.runs, :], mask[: analysis.runs]).p > analysis.drop_above
            # The first analysis that drops a module decides; later runs of it do not exist in a study.
            dropped = np.where((dropped == 0) & hopeless, analysis.runs, dropped)
    p = np.where(dropped == 0, clustered_t(array, mask).p, 1.0)
    return RaceResult(dropped, np.where(dropped == 0, mask.shape[0], dropped), p)


@dataclass(frozen=True)
class RaceRates:
    """Operating characteristics of a race for a module of known effect, over simulated studies.

    Attributes:
        confirmed: fraction with p below alpha at the end.
        confirmed_without: fraction confirmed without interim analyses.
        dropped: fraction dropped at each interim analysis, by number of runs.
        mean_runs: mean number of runs of the module.
    """

    confirmed: float
    confirmed_without: float
    dropped: dict[int, float]
    mean_runs: float


def race_rates(
    delta: float,
    variance: PairedVariance,
    tested: ArrayLike,
    interim_analyses: Sequence[InterimAnalysis] = INTERIM_ANALYSES,
    *,
    alpha: float = 0.05,
    repetitions: int = 2000,
    seed: int = 0,
) -> RaceRates:
    """Return the error rates of a race by Monte Carlo on the cells of a design: alpha at ``delta = 0``, power above.

    Args:
        delta: improvement, in the unit of the scores.
        variance: variance components of the paired differences.
        tested: ``(run, session)``.
        interim_analyses: numbers of runs in ascending order.
        alpha: level of the test at the end.
        repetitions: simulated studies.
        seed: random seed.
    """
    mask = check_tested_mask(tested, np.asarray(tested).shape)
    draws = simulate_differences(variance, mask, -delta, repetitions, np.random.default_rng(seed))
    raced = race(draws, mask, interim_analyses)
    return RaceRates(
        confirmed=float((raced.p < alpha).mean()),
        confirmed_without=float((clustered_t(draws, mask).p < alpha).mean()),
        dropped={analysis.runs: float((raced.dropped_after == analysis.runs).mean()) for analysis in interim_analyses},
        mean_runs=float(raced.runs.mean()),
    )


def _check(interim_analyses: Sequence[InterimAnalysis]) -> None:
    runs = [analysis.runs for analysis in interim_analyses]
    if runs != sorted(set(runs)) or any(n < 2 for n in runs):
        raise ConfigError(
            f"interim analyses after {runs} runs came; they must ascend and the first be after 2 runs or more"
        )
    if any(not 0.0 < analysis.drop_above <= 1.0 for analysis in interim_analyses):
        raise ConfigError("an interim analysis drops above a p-value between 0 and 1")
