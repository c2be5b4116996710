"""The thesis's decision on modules (section 3.3.4); for comparison, since it does not keep its level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import DataError
from edp.stats.checks import Mask, finite
from edp.stats.effects import cohens_dz, rank_stability
from edp.stats.mixed import mixed_model
from edp.stats.multiple import benjamini_hochberg
from edp.stats.resampled import printed_p

MIN_DZ = 0.5
"""Minimum effect size in the thesis (3.3.4): a medium effect (Cohen's d)."""
MIN_STABILITY = 0.75
"""Minimum fraction of pairs of runs with an improvement, the third criterion of the thesis."""


@dataclass(frozen=True)
class ThesisEvidence:
    """The thesis's three gates for one module on one metric.

    Attributes:
        module, metric: names.
        beta: fixed effect of the module, negative is better.
        p: one-sided z-test of the mixed model.
        adjusted: Benjamini-Hochberg over all modules and metrics at once ("globally", 3.3.4).
        printed_p: p-value printed in Table 4.5, Phi(d_z sqrt(J)).
        d_z: effect size of the differences of split means.
        stability: fraction of the J S pairs with an improvement.
        passed: all three gates on this metric.
        confirmed: the module passed on any metric.
    """

    module: str
    metric: str
    beta: float
    p: float
    adjusted: float
    printed_p: float
    d_z: float
    stability: float
    passed: bool
    confirmed: bool


def thesis_confirm(
    scores: ArrayLike, modules: Sequence[str], metrics: Sequence[str], alpha: float = 0.05
) -> tuple[ThesisEvidence, ...]:
    """Apply the thesis's confirmation: mixed model per metric, global adjustment, three gates, any metric suffices.

    Args:
        scores: ``(metric, 1 + module, split, seed)``, the baseline first; each run's score over its test sessions.
        modules: names of the arms after the baseline.
        metrics: names; the thesis has MAE, RMSE, P95 and P99.
        alpha: level of the adjusted p-values.

    Returns:
        One for each module and metric, modules outermost.

    Raises:
        DataError: names and scores do not fit, or values that are not finite.
    """
    array = finite(scores, "table of scores", 4)
    if array.ndim != 4 or array.shape[:2] != (len(metrics), 1 + len(modules)) or not modules:
        raise DataError(
            f"scores of shape {array.shape} came for {len(metrics)} metrics and {len(modules)} modules; give "
            "(metric, 1 + module, split, seed)"
        )
    module, baseline = array[:, 1:], array[:, :1]
    effect = mixed_model(module, baseline).effect
    adjusted = benjamini_hochberg(effect.p.ravel()).reshape(effect.p.shape)
    difference = module - baseline
    d_z = cohens_dz(difference.mean(axis=-1))
    stability = rank_stability(difference.reshape(*difference.shape[:2], -1))
    gates = (adjusted < alpha, d_z <= -MIN_DZ, effect.mean < 0.0, stability >= MIN_STABILITY)
    passed: Mask = np.asarray(np.logical_and.reduce(gates), dtype=bool)
    printed = printed_p(d_z, array.shape[2])
    confirmed = np.asarray(passed.any(axis=0))
    return tuple(
        ThesisEvidence(
            module=name,
            metric=metric,
            beta=float(effect.mean[i, j]),
            p=float(effect.p[i, j]),
            adjusted=float(adjusted[i, j]),
            printed_p=float(printed[i, j]),
            d_z=float(d_z[i, j]),
            stability=float(stability[i, j]),
            passed=bool(passed[i, j]),
            confirmed=bool(confirmed[j]),
        )
        for j, name in enumerate(modules)
        for i, metric in enumerate(metrics)
    )
