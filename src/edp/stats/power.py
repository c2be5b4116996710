"""How many runs it takes to see an effect, and whether any number does."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import nctdtr, stdtrit

from edp.errors import ConfigError
from edp.stats.checks import Array, check_tested_mask
from edp.stats.clustered import clustered_t
from edp.stats.variance import PairedVariance
from edp.wording import figure


@dataclass(frozen=True)
class ConfirmationPlan:
    """Length of a confirmation that reaches the required power.

    Attributes:
        runs: training runs per arm, a whole number of repeats; None if no number suffices.
        power: power for this number of runs.
        limit: power for infinitely many runs on these sessions.
        sessions_needed: number of sessions for which `runs` runs suffice; None if the present sessions suffice.
        reason: result as a sentence.
    """

    runs: int | None
    power: float
    limit: float
    sessions_needed: int | None
    reason: str


def power(delta: float, variance: PairedVariance, sessions: int, runs: float, folds: int, alpha: float) -> float:
    """Return the power of the clustered t-test in closed form, from the noncentral t-distribution.

    Args:
        delta: improvement of the mean score to be seen, above zero.
        variance: variance components of the paired differences.
        sessions: development sessions.
        runs: training runs of each arm; infinite is allowed.
        folds: into which the sessions are dealt.
        alpha: level of the test.
    """
    error = math.sqrt(variance.compute_mean_variance(sessions, runs, sessions / folds))
    df = min(float(sessions), runs) - 1.0
    # No variance at all: any difference is seen.
    if error == 0.0:
        return 1.0
    critical = float(stdtrit(df, alpha))
    return float(nctdtr(df, -delta / error, critical))


def plan_runs(
    delta: float,
    variance: PairedVariance,
    sessions: int,
    *,
    folds: int = 5,
    alpha: float = 0.05,
    target: float = 0.80,
    most: int = 200,
) -> ConfirmationPlan:
    """Return the smallest number of runs, in whole repeats of the folds, that reaches the target power.

    With several modules give ``alpha / modules``: the first step of Benjamini-Hochberg, which a single true module
    among null ones has to pass.

    Args:
        delta: improvement to be seen, in the unit of the scores, above zero.
        variance: variance components of the paired differences.
        sessions: development sessions.
        folds: into which they are dealt.
        alpha: level of the test.
        target: power wanted.
        most: runs allowed.

    Raises:
        ConfigError: a delta that is not above zero, fewer sessions than folds, or levels outside 0 to 1.
    """
    if delta <= 0.0 or not (0.0 < alpha < 1.0 and 0.0 < target < 1.0):
        raise ConfigError(f"delta {delta}, alpha {alpha}, power {target} came; all must be above 0, the last below 1")
    if sessions < folds or folds < 2:
        raise ConfigError(f"{sessions} sessions cannot be dealt into {folds} folds; record more or set fewer folds")
    # Asked first: where endlessly many runs do not suffice, no search for a number is needed.
    limit = power(delta, variance, sessions, math.inf, folds, alpha)
    if limit < target:
        needed = _sessions_needed(delta, variance, folds, alpha, target)
        text = f"at least {needed} sessions are needed" if needed else "10,000 sessions would not do"
        reason = (
            f"no number of runs suffices: with {sessions} sessions the power cannot exceed {limit:.2f}, since the "
            f"module's effect differs between sessions (sd {figure(math.sqrt(variance.session), 3)}); {text}"
        )
        return ConfirmationPlan(None, limit, limit, needed, reason)
    # Use whole repeats only, since a partial repeat would evaluate some sessions more often than others.
    for runs in range(folds, most + 1, folds):
        reached = power(delta, variance, sessions, runs, folds, alpha)
        if reached >= target:
            return ConfirmationPlan(
                runs, reached, limit, None, f"{runs} runs of each arm give a power of {reached:.2f}"
            )
    most -= most % folds
    reached = power(delta, variance, sessions, most, folds, alpha) if most else 0.0
    reason = f"{most} runs, the most allowed, give a power of {reached:.2f}; allow more, or look for a larger effect"
    return ConfirmationPlan(None, reached, limit, None, reason)


def _sessions_needed(delta: float, variance: PairedVariance, folds: int, alpha: float, target: float) -> int | None:
    """Return the smallest number of sessions at which infinitely many runs reach the target; None above 10,000."""
    # Bisection: the power rises with the sessions.
    low, high = folds, 10_000
    if power(delta, variance, high, math.inf, folds, alpha) < target:
        return None
    while low < high:
        middle = (low + high) // 2
        if power(delta, variance, middle, math.inf, folds, alpha) >= target:
            high = middle
        else:
            low = middle + 1
    return low


def simulate_differences(
    variance: PairedVariance, tested: ArrayLike, mean: ArrayLike, repetitions: int, rng: np.random.Generator
) -> Array:
    """Return normal paired differences with the given variances and mean, ``(repetition, run, session)``."""
    mask = np.asarray(tested, dtype=bool)
    runs, sessions = mask.shape
    draw = math.sqrt(variance.session) * rng.standard_normal((repetitions, 1, sessions))
    draw = draw + math.sqrt(variance.run) * rng.standard_normal((repetitions, runs, 1))
    draw = draw + math.sqrt(variance.cell) * rng.standard_normal((repetitions, runs, sessions))
    return np.asarray(np.where(mask, draw + np.asarray(mean), 0.0))


def simulated_power(
    delta: float,
    variance: PairedVariance,
    tested: ArrayLike,
    *,
    alpha: float = 0.05,
    repetitions: int = 2000,
    seed: int = 0,
) -> float:
    """Return the power of the clustered t-test by Monte Carlo on the cells of a planned study.

    Args:
        delta: improvement, in the unit of the scores.
        variance: variance components of the paired differences.
        tested: ``(run, session)``.
        alpha: level of the test.
        repetitions: simulated studies.
        seed: random seed.
    """
    mask = check_tested_mask(tested, np.asarray(tested).shape)
    draws = simulate_differences(variance, mask, -delta, repetitions, np.random.default_rng(seed))
    return float((clustered_t(draws, mask).p < alpha).mean())
