"""The default decision on modules: race, clustered test, adjustment over all registered, practical gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import ConfigError, DataError
from edp.stats.checks import Array, Mask, check_tested_mask
from edp.stats.clustered import clustered_t
from edp.stats.effects import EffectSize, effect_size, rank_stability
from edp.stats.mixed import mixed_model
from edp.stats.multiple import adjust_registered
from edp.stats.paired import fill_worst, run_means
from edp.stats.race import INTERIM_ANALYSES, InterimAnalysis, race
from edp.stats.resampled import paired_t, resampled_t
from edp.wording import figure, percent, percent_interval


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Acceptance criteria of a module: significance level and minimum improvement.

    Attributes:
        alpha: level of the adjusted p-value.
        least_gain: minimum improvement of the mean score over the baseline's that is relevant, as a fraction.
        interim_analyses: interim analyses of the race; empty to run every module to the end.
        level: confidence level of the intervals.
    """

    alpha: float = 0.05
    least_gain: float = 0.01
    interim_analyses: tuple[InterimAnalysis, ...] = INTERIM_ANALYSES
    level: float = 0.95

    def __post_init__(self) -> None:
        if not (0.0 < self.alpha < 1.0 and 0.0 < self.level < 1.0 and self.least_gain >= 0.0):
            raise ConfigError(
                f"alpha {self.alpha}, level {self.level}, least_gain {self.least_gain} came; the first two must lie "
                "between 0 and 1, the last not below 0"
            )


@dataclass(frozen=True)
class ModuleEvidence:
    """Result of a confirmation for one module. Negative differences are improvements.

    Attributes:
        module: name.
        confirmed: whether the module passed all criteria.
        reason: reason of the decision as a sentence.
        runs: number of runs of the module; 0 if the module did not reach the confirmation.
        dropped_after: number of runs after which the race dropped the module; 0 if it was not dropped.
        change: mean difference over the baseline's mean score.
        low, high: interval of `change`.
        p, adjusted: p-value of the clustered test, plain and adjusted over all registered modules.
        resampled_p: p-value of Nadeau and Bengio's test on run means.
        paired_p: p-value of the plain t-test on run means.
        mixed_p: p-value of the thesis's mixed model on run means.
        d_z: effect size of the run means; None with fewer than two runs.
        stability: fraction of the runs in which the module improved the score.
    """

    module: str
    confirmed: bool
    reason: str
    runs: int = 0
    dropped_after: int = 0
    change: float | None = None
    low: float | None = None
    high: float | None = None
    p: float = 1.0
    adjusted: float = 1.0
    resampled_p: float | None = None
    paired_p: float | None = None
    mixed_p: float | None = None
    d_z: EffectSize | None = None
    stability: float | None = None


def confirm(
    scores: ArrayLike,
    modules: Sequence[str],
    registered: Sequence[str],
    tested: ArrayLike | None = None,
    rule: Rule | None = None,
    worst: ArrayLike | None = None,
) -> tuple[ModuleEvidence, ...]:
    """Decide on every registered module from scores on one primary metric.

    Args:
        scores: ``(1 + module, run, session)``, the baseline first, lower is better. A failed planned cell is NaN or
            infinite and counts as the worst score. Runs after the race dropped a module are not read.
        modules: names of the arms after the baseline.
        registered: every module of the study, in the order of the results; modules not in `modules` were dropped
            earlier and enter the adjustment with p = 1.
        tested: mask of the evaluated cells ``(run, session)``; None means that every run is evaluated on every session.
        rule: acceptance criteria; None for the defaults.
        worst: minimum loss of a failed cell ``(session,)``; see `fill_worst`.

    Raises:
        DataError: names and scores do not fit, a baseline score that is not above zero, or see `fill_worst`.
    """
    rule = rule or Rule()
    array = np.asarray(scores, dtype=np.float64)
    if array.ndim != 3 or array.shape[0] != 1 + len(modules) or not modules:
        raise DataError(
            f"scores of shape {array.shape} came for {len(modules)} modules; give (1 + module, run, session)"
        )
    mask = check_tested_mask(tested, array.shape)
    # All arms at once, so that a failure costs every module the same.
    filled = fill_worst(array, mask, worst)
    differences = filled[1:] - filled[0]
    raced = race(differences, mask, rule.interim_analyses)
    # Adjust over all registered modules, because modules dropped earlier were tried on the same sessions.
    adjusted = adjust_registered({name: float(p) for name, p in zip(modules, raced.p)}, registered)
    evidence = {}
    for index, name in enumerate(modules):
        runs, dropped = int(raced.runs[index]), int(raced.dropped_after[index])
        part = mask[:runs]
        # A module that was dropped early may not have met every session.
        seen = part.any(axis=0)
        cells = _Cells(filled[1 + index, :runs][:, seen], filled[0, :runs][:, seen], part[:, seen])
        evidence[name] = _evidence(name, cells, dropped, adjusted[name], rule)
    absent = "stopped by the screening, counted with p = 1"
    return tuple(evidence.get(name, ModuleEvidence(name, False, absent)) for name in registered)


@dataclass(frozen=True)
class _Cells:
    """Scores of a module and of the baseline, and which of them exist; each ``(run, session)``."""

    module: Array
    baseline: Array
    mask: Mask


def _evidence(name: str, cells: _Cells, dropped: int, adjusted: float, rule: Rule) -> ModuleEvidence:
    """Return all figures on one module."""
    module, baseline, mask = cells.module, cells.baseline, cells.mask
    difference = module - baseline
    reference = float(baseline[mask].mean())
    if reference <= 0.0:
        raise DataError(f"the baseline's mean score is {figure(reference)}; shares need a score above zero")
    test = clustered_t(difference, mask)
    low, high = (float(bound) / reference for bound in test.interval(rule.level))
    change = float(test.mean) / reference
    means = run_means(difference, mask)
    runs = len(means)
    judged = mask.sum() / runs
    # Ratio of test sessions to training sessions; 0 if every session is tested, which gives the plain t-test.
    ratio = float(judged / (mask.shape[1] - judged)) if mask.shape[1] > judged else 0.0
    mixed = mixed_model(run_means(module, mask)[:, None], run_means(baseline, mask)[:, None])
    # Require both significance and relevance, because many runs make any difference significant.
    confirmed = not dropped and adjusted < rule.alpha and change <= -rule.least_gain
    resampled = float(resampled_t(means, ratio).p)
    reason = _reason((change, low, high), adjusted, dropped, float(test.p), rule)
    if confirmed and resampled >= rule.alpha:
        reason += (
            f"; the corrected resampled t-test does not agree (p {figure(resampled, 2)}): if the module depends on "
            "what all "
            "training sets share, more sessions are needed"
        )
    return ModuleEvidence(
        module=name,
        confirmed=confirmed,
        reason=reason,
        runs=runs,
        dropped_after=dropped,
        change=change,
        low=low,
        high=high,
        p=1.0 if dropped else float(test.p),
        adjusted=adjusted,
        resampled_p=resampled,
        paired_p=float(paired_t(means).p),
        mixed_p=float(mixed.effect.p),
        d_z=effect_size(means, rule.level),
        stability=float(rank_stability(means)),
    )


def _reason(change: tuple[float, float, float], adjusted: float, dropped: int, p: float, rule: Rule) -> str:
    """Return why a module is in or out, with the figures."""
    middle, low, high = change
    figures = f"{percent(middle, signed=True)} ({percent_interval(low, high)})"
    if dropped:
        return f"dropped after {dropped} runs: {figures}, p {figure(p, 2)}, no sign of an improvement"
    if adjusted >= rule.alpha:
        return f"{figures}, but adjusted p {figure(adjusted, 2)} is not below {figure(rule.alpha)}"
    if middle > -rule.least_gain:
        return (
            f"{figures}: significant (adjusted p {figure(adjusted, 2)}), but below the "
            f"{figure(100 * rule.least_gain)} % asked for"
        )
    return f"{figures}, adjusted p {figure(adjusted, 2)}"
