"""Races: modules without promise are dropped early, which costs power but no alpha."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edp.errors import ConfigError
from edp.stats.checks import Array, tested_mask
from edp.stats.clustered import clustered_t
from edp.stats.power import simulate_differences
from edp.stats.variance import PairedVariance


@dataclass(frozen=True)
class Look:
    """A look at the data so far.

    Attributes:
        runs: after which it is taken.
        drop_above: a module with a larger one-sided p-value is dropped.
    """

    runs: int
    drop_above: float


LOOKS = (Look(5, 0.35), Look(10, 0.15), Look(15, 0.08))
"""Looks after one, two and three repeats of five folds."""


@dataclass(frozen=True, eq=False)
class RaceResult:
    """Where each module stands; arrays over the leading axes of the differences.

    Attributes:
        dropped_after: runs after which it was dropped; 0 where it went all the way.
        runs: that it took.
        p: one-sided p-value over all runs; 1 where it was dropped.
    """

    dropped_after: NDArray[np.int64]
    runs: NDArray[np.int64]
    p: Array


def race(differences: ArrayLike, tested: ArrayLike | None = None, looks: Sequence[Look] = LOOKS) -> RaceResult:
    """Walk through the looks, then test what is left over all runs.

    Looks can only drop. A module that no look dropped is judged by the same test as without looks, so under the
    null the probability of confirming it can only fall: futility looks spend no alpha.

    Args:
        differences: ``(..., run, session)`` in the order of the runs; what comes after the look that drops a
            module is not used.
        tested: ``(run, session)``; None: all.
        looks: in ascending order; those at or beyond the number of runs are not taken.

    Raises:
        ConfigError: looks out of order, before the second run, or with levels outside 0 to 1.
        DataError: as `clustered_t`.
    """
    _check(looks)
    array = np.asarray(differences, dtype=np.float64)
    mask = tested_mask(tested, array.shape)
    dropped = np.zeros(array.shape[:-2], dtype=np.int64)
    for look in looks:
        if look.runs < mask.shape[0]:
            hopeless = clustered_t(array[..., : look.runs, :], mask[: look.runs]).p > look.drop_above
            dropped = np.where((dropped == 0) & hopeless, look.runs, dropped)
    p = np.where(dropped == 0, clustered_t(array, mask).p, 1.0)
    return RaceResult(dropped, np.where(dropped == 0, mask.shape[0], dropped), p)


@dataclass(frozen=True)
class RaceRates:
    """What a race does with a module of a known effect, over simulated studies.

    Attributes:
        confirmed: share with p below alpha at the end.
        confirmed_without: the same with no look.
        dropped: share dropped at each look, by its number of runs.
        mean_runs: of the module.
    """

    confirmed: float
    confirmed_without: float
    dropped: dict[int, float]
    mean_runs: float


def race_rates(
    delta: float,
    variance: PairedVariance,
    tested: ArrayLike,
    looks: Sequence[Look] = LOOKS,
    *,
    alpha: float = 0.05,
    repetitions: int = 2000,
    seed: int = 0,
) -> RaceRates:
    """Error rates of a race by Monte Carlo on the cells of a design: alpha at ``delta = 0``, power above.

    Args:
        delta: improvement, in the unit of the scores.
        variance: of the paired differences.
        tested: ``(run, session)``.
        looks: in ascending order.
        alpha: level of the test at the end.
        repetitions: simulated studies.
        seed: of the draws.
    """
    mask = tested_mask(tested, np.asarray(tested).shape)
    draws = simulate_differences(variance, mask, -delta, repetitions, np.random.default_rng(seed))
    raced = race(draws, mask, looks)
    return RaceRates(
        confirmed=float((raced.p < alpha).mean()),
        confirmed_without=float((clustered_t(draws, mask).p < alpha).mean()),
        dropped={look.runs: float((raced.dropped_after == look.runs).mean()) for look in looks},
        mean_runs=float(raced.runs.mean()),
    )


def _check(looks: Sequence[Look]) -> None:
    runs = [look.runs for look in looks]
    if runs != sorted(set(runs)) or any(n < 2 for n in runs):
        raise ConfigError(f"looks after {runs} runs came; they must ascend and the first be after 2 runs or more")
    if any(not 0.0 < look.drop_above <= 1.0 for look in looks):
        raise ConfigError("a look drops above a p-value between 0 and 1")
