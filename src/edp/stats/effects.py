"""Effect sizes: Cohen's d_z with an interval, the fraction of pairs won, and agreement of rankings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, nctdtrinc

from edp.errors import DataError
from edp.stats.checks import Array, finite


@dataclass(frozen=True)
class EffectSize:
    """Cohen's d_z: the mean difference over the standard deviation (n - 1) of the differences.

    Attributes:
        value: negative where the module is better; infinite where all differences are equal and not zero.
        low, high: interval from the noncentral t-distribution. It takes the splits for independent, so with
            overlapping training sets it is too narrow.
    """

    value: float
    low: float
    high: float


def cohens_dz(differences: ArrayLike) -> Array:
    """Return the d_z over the last axis, ``(..., split)``; zero where all differences are zero.

    Raises:
        DataError: fewer than two splits or values that are not finite.
    """
    array = finite(differences, "list of split differences", 1)
    if array.shape[-1] < 2:
        raise DataError("one split has no spread; d_z needs at least two")
    mean, spread = array.mean(axis=-1), array.std(axis=-1, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Equal differences leave rounding errors as spread, which would look like a huge effect.
        ratio = np.where(mean == 0.0, 0.0, mean / np.where(spread > 1e-14 * np.abs(mean), spread, 0.0))
    return np.asarray(ratio)


def effect_size(differences: ArrayLike, level: float = 0.95) -> EffectSize:
    """Return the d_z of one list of split differences, with its interval.

    Raises:
        DataError: see `cohens_dz`.
    """
    value = float(cohens_dz(differences))
    return effect_interval(value, int(np.asarray(differences).shape[-1]), level)


def effect_interval(d_z: float, splits: int, level: float = 0.95) -> EffectSize:
    """Return the confidence interval of a d_z from `splits` splits.

    Its ends are the noncentrality parameters at which the observed t is just significant.

    Raises:
        DataError: fewer than two splits.
    """
    if splits < 2:
        raise DataError("one split has no spread; d_z needs at least two")
    if not math.isfinite(d_z):
        return EffectSize(d_z, d_z, d_z)
    root, tail = math.sqrt(splits), 0.5 - 0.5 * level
    # SciPy's inverse seeks a noncentrality from zero upwards in some builds, so the sign is kept apart.
    size = abs(d_z) * root
    low, high = (float(_noncentrality(size, splits - 1, p)) / root for p in (1.0 - tail, tail))
    return EffectSize(d_z, low, high) if d_z >= 0.0 else EffectSize(d_z, -high, -low)


def _noncentrality(statistic: float, df: int, probability: float) -> float:
    """Return the noncentrality for which a t variable is below `statistic` with `probability`."""
    return float(nctdtrinc(df, probability, statistic))


def rank_stability(differences: ArrayLike) -> Array:
    """Return the fraction of paired observations in which the module is better, over the last axis; ties do not count.

    The thesis's third criterion requires three quarters of the N = J S pairs of runs.

    Raises:
        DataError: empty or values that are not finite.
    """
    return np.asarray((finite(differences, "list of paired differences", 1) < 0.0).mean(axis=-1))


@dataclass(frozen=True)
class Concordance:
    """Kendall's coefficient W of rankings.

    Attributes:
        w: 1 where every split ranks the modules alike, about 1 / splits where the ranks are chance.
        p: p-value of no agreement, by the chi-square approximation ``splits (modules - 1) W``.
    """

    w: float
    p: float


def kendalls_w(scores: ArrayLike) -> Concordance:
    """Test whether splits rank modules equally; equal scores have their mean rank.

    Args:
        scores: ``(split, module)``.

    Raises:
        DataError: fewer than two splits or modules, values that are not finite, or no split that tells them apart.
    """
    array = finite(scores, "table of scores", 2)
    if array.ndim != 2 or min(array.shape) < 2:
        raise DataError(f"the scores have shape {array.shape}; give at least two splits of at least two modules")
    splits, modules = array.shape
    # Imported at first use: scipy.stats takes half a second, and every command imports this room.
    from scipy.stats import rankdata

    ranks = rankdata(array, axis=1)
    ties = sum(float((counts**3 - counts).sum()) for counts in (np.unique(row, return_counts=True)[1] for row in ranks))
    spread = float(np.square(ranks.sum(axis=0) - splits * (modules + 1) / 2).sum())
    # Kendall's correction for ties: equal scores lower the largest possible spread of the ranks.
    scale = splits**2 * (modules**3 - modules) - splits * ties
    if scale <= 0.0:
        raise DataError("all modules are equal in every split; there is nothing to rank")
    w = 12.0 * spread / scale
    return Concordance(w, float(chdtrc(modules - 1, splits * (modules - 1) * w)))
