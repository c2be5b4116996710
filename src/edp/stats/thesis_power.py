"""The thesis's power analysis, eq. 2.19 to 2.21 and 3.42."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from edp.errors import ConfigError

MAX_SPLITS = 25
"""Maximum number of splits in eq. 3.42: the number of sessions in the thesis's development set."""


@dataclass(frozen=True)
class ThesisPlan:
    """Number of splits after eq. 3.42.

    Attributes:
        splits: J = min(max(n_mc, n_analytical), 25), rounded up.
        simulated: n_mc; None if 25 splits do not reach the power.
        analytical: n of eq. 2.21, not rounded.
    """

    splits: int
    simulated: int | None
    analytical: float


def thesis_splits_analytical(
    delta: float, sigma_seed: float, seeds: int, alpha: float = 0.05, power: float = 0.80
) -> float:
    """Return the eq. 2.21: ``((z_{1-alpha} + z_{1-beta}) sigma_seed / sqrt(S) / delta)^2``.

    A paired difference of two runs has twice the seeds' variance, and a module may suit one split and not
    another; neither is in the formula, so it plans too few splits. `plan_runs` has both.

    Raises:
        ConfigError: a value that is not above zero.
    """
    if min(delta, sigma_seed, seeds) <= 0.0:
        raise ConfigError(f"delta {delta}, sigma_seed {sigma_seed}, seeds {seeds} came; all must be above zero")
    reach = float(ndtri(1.0 - alpha) + ndtri(power))
    return (reach * sigma_seed / math.sqrt(seeds) / delta) ** 2


def thesis_power(
    splits: int,
    delta: float,
    sigma_seed: float,
    seeds: int,
    *,
    alpha: float = 0.05,
    experiments: int = 3000,
    seed: int = 0,
) -> float:
    """Return the fraction of simulated experiments in which the thesis's one-tailed test rejects (eq. 2.19 and 2.20).

    The test divides by the sample standard deviation, but takes the quantile of the normal distribution, as the printed
    p-values of Table 4.5 do. Its power is that of a noncentral t variable above this quantile, and exceeds the power of
    a z-test with a known standard deviation. At two splits, ``delta = 0.866 sigma_seed`` and one seed the power is 0.50
    in place of 0.34, because the test rejects too often: 0.17 in place of 0.05 without any effect.

    Raises:
        ConfigError: fewer than two splits or a value that is not above zero.
    """
    if splits < 2 or min(delta, sigma_seed, seeds) <= 0.0:
        raise ConfigError("the thesis's power needs two splits at least, and delta, sigma_seed and seeds above zero")
    # Each number of splits has its own random stream, so a power does not depend on the other requested numbers.
    rng = np.random.default_rng([seed, splits])
    drawn = rng.normal(-delta, sigma_seed / math.sqrt(seeds), (experiments, splits))
    z = drawn.mean(axis=1) / (drawn.std(axis=1, ddof=1) / math.sqrt(splits))
    return float((ndtr(z) < alpha).mean())


def thesis_plan(
    baseline_mae: float,
    sigma_seed: float,
    seeds: int,
    *,
    share: float = 0.02,
    alpha: float = 0.05,
    power: float = 0.80,
    seed: int = 0,
) -> ThesisPlan:
    """Return J after eq. 3.42 for a detectable effect of `share` (fraction of the baseline's mean absolute error).

    Raises:
        ConfigError: a value that is not above zero.
    """
    delta = share * baseline_mae
    analytical = thesis_splits_analytical(delta, sigma_seed, seeds, alpha, power)
    simulated = next(
        (
            n
            for n in range(2, MAX_SPLITS + 1)
            if thesis_power(n, delta, sigma_seed, seeds, alpha=alpha, seed=seed) >= power
        ),
        None,
    )
    split_count = MAX_SPLITS if simulated is None else max(simulated, math.ceil(analytical))
    return ThesisPlan(min(split_count, MAX_SPLITS), simulated, analytical)
