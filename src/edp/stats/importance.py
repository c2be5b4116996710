"""Main effects and importances of modules from a designed screening, by least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import DataError
from edp.stats.checks import finite, lower_p

PASS_AT = 0.30
"""Maximum one-sided p-value of a module that passes the screening. The screening should lose few effective modules; a
later test confirms them."""


@dataclass(frozen=True)
class MainEffect:
    """Mean effect of one factor on the score, averaged over all other factors.

    Attributes:
        factor: name.
        effect: mean score with the factor minus mean score without it, in the unit of the scores; negative is better.
        error: standard error.
        p: one-sided, small where on is better.
        importance: fraction of the explained variance that belongs to the factor, 0 to 1.
        passed: p is at most the screening's level.
    """

    factor: str
    effect: float
    error: float
    p: float
    importance: float
    passed: bool


def main_effects(
    levels: ArrayLike,
    factors: Sequence[str],
    scores: ArrayLike,
    covariates: ArrayLike | None = None,
    pass_at: float = PASS_AT,
) -> tuple[MainEffect, ...]:
    """Regress the scores on all factors at once, and on covariates such as randomised rates.

    Args:
        levels: ``(run, factor)``, True if the factor is on; a repeated design is stacked.
        factors: names.
        scores: ``(run,)``; failed runs filled with the worst.
        covariates: ``(run, covariate)``; None: none.
        pass_at: one-sided p-value up to which a factor passes.

    Returns:
        One effect per factor, in the order of the factors.

    Raises:
        DataError: shapes that do not fit, values that are not finite, a factor that never changes or cannot be
            distinguished from others, or no run left to estimate the noise from.
    """
    y = finite(scores, "list of scores", 1)
    on = np.asarray(levels, dtype=bool)
    if y.ndim != 1 or on.shape != (y.size, len(factors)):
        raise DataError(f"{y.size} scores of {len(factors)} factors came with levels of shape {on.shape}")
    # Half a unit to either side: a coefficient is then the effect of on minus off.
    columns = [np.ones(y.size), *np.where(on, 0.5, -0.5).T]
    if covariates is not None:
        extra = finite(covariates, "table of covariates", 2)
        if extra.shape[0] != y.size:
            raise DataError(f"{extra.shape[0]} rows of covariates came for {y.size} scores")
        scale = extra.std(axis=0)
        if (scale == 0.0).any():
            raise DataError("a covariate never changes; leave it out")
        columns += list(((extra - extra.mean(axis=0)) / scale).T)
    design = np.stack(columns, axis=1)
    free = y.size - design.shape[1]
    if free < 1:
        raise DataError(f"{y.size} runs came for {design.shape[1]} coefficients; repeat the design")
    # Beyond the root of float64's precision the normal equations have no digit left.
    if np.linalg.cond(design) > 1e8:
        raise DataError(
            "some factors or covariates cannot be distinguished; every factor must change, each in its own way"
        )
    inverse = np.linalg.inv(design.T @ design)
    coefficients = inverse @ (design.T @ y)
    # Equal scores leave rounding errors in the coefficients and residuals.
    dust = 1e-13 * float(np.abs(y).max())
    coefficients = np.where(np.abs(coefficients) > dust, coefficients, 0.0)
    noise = float(np.square(y - design @ coefficients).sum()) / free
    noise = noise if noise > dust**2 else 0.0
    chosen = slice(1, 1 + len(factors))
    effect, spread = coefficients[chosen], np.diag(inverse)[chosen]
    error = np.sqrt(noise * spread)
    # The rise of the residual sum without the factor, so that factors that change seldom are not favoured.
    explained = np.square(effect) / spread
    total = float(explained.sum())
    _, p = lower_p(effect, error, free)
    return tuple(
        MainEffect(
            factor=name,
            effect=float(effect[i]),
            error=float(error[i]),
            p=float(p[i]),
            importance=float(explained[i] / total) if total > 0.0 else 0.0,
            passed=bool(p[i] <= pass_at),
        )
        for i, name in enumerate(factors)
    )
