"""The thesis's linear mixed-effects model, eq. 2.22, in closed form for balanced data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import DataError
from edp.stats.checks import Array, finite, lower_p
from edp.stats.clustered import MeanTest


@dataclass(frozen=True, eq=False)
class MixedModel:
    """Restricted maximum likelihood fit of ``y = b0 + b1 module + u_split + e``; arrays over leading axes.

    Attributes:
        intercept: b0, mean of the baseline.
        effect: test of b1 < 0 by z, as the thesis does.
        split_variance: variance of the random intercepts; zero if splits differ by less than chance.
        residual_variance: variance of the runs within a split.
    """

    intercept: Array
    effect: MeanTest
    split_variance: Array
    residual_variance: Array


def mixed_model(module: ArrayLike, baseline: ArrayLike) -> MixedModel:
    """Fit eq. 2.22 to balanced data.

    With J splits, S seeds and both arms in each cell the arms are orthogonal to the splits, so b1 is the difference
    of the means and its variance ``2 s_e^2 / (J S)``. The residual variance is the mean square within splits, or,
    if the split variance would be negative, the mean square of all deviations. The solution needs no iteration.

    The model has one intercept per split for both arms. It ignores effects of a split on the difference, and treats
    overlapping splits as independent. Its p-values are too small; `clustered_t` is the default.

    Args:
        module: ``(..., split, seed)``.
        baseline: scores of the baseline, same shape.

    Raises:
        DataError: unequal shapes, fewer than two splits, or values that are not finite (fill failed runs first).
    """
    candidate, reference = finite(module, "table of the module", 2), finite(baseline, "table of the baseline", 2)
    if candidate.shape[-2:] != reference.shape[-2:]:
        raise DataError(
            f"the module has scores of shape {candidate.shape}, the baseline {reference.shape}; pair equal cells"
        )
    splits, seeds = candidate.shape[-2:]
    if splits < 2:
        raise DataError(f"{splits} split came; a random intercept per split needs at least two")
    candidate, reference = np.broadcast_arrays(candidate, reference)
    cells = splits * seeds
    b0 = reference.mean(axis=(-2, -1))
    b1 = (candidate - reference).mean(axis=(-2, -1))
    values = np.stack([candidate - b1[..., None, None], reference], axis=-1)  # (..., split, seed, arm)
    by_split = values.mean(axis=(-2, -1), keepdims=True)
    within = np.square(values - by_split).sum(axis=(-3, -2, -1))
    between = 2 * seeds * np.square(by_split - by_split.mean(axis=-3, keepdims=True)).sum(axis=(-3, -2, -1))
    free = 2 * cells - splits - 1
    if free < 1:
        raise DataError(f"{splits} splits of {seeds} seeds leave no degree of freedom; add splits or seeds")
    residual = within / free
    split = (between / (splits - 1) - residual) / (2 * seeds)
    # A variance cannot be negative: without the split's part all mean squares estimate the residual.
    residual = np.where(split > 0.0, residual, (within + between) / (2 * cells - 2))
    error = np.sqrt(2.0 * residual / cells)
    statistic, p = lower_p(b1, error, np.inf)
    effect = MeanTest(np.asarray(b1), np.asarray(error), statistic, np.inf, p)
    return MixedModel(np.asarray(b0), effect, np.maximum(split, 0.0), np.asarray(residual))
