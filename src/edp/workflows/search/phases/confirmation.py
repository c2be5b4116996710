"""Phase 3: modules against the baseline over repeated folds (thesis 3.3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from edp.config.experiment import Table
from edp.stats.checks import Mask
from edp.stats.clustered import clustered_t
from edp.stats.confirm import ModuleEvidence, Rule, confirm
from edp.stats.paired import fill_worst
from edp.stats.race import INTERIM_ANALYSES, InterimAnalysis
from edp.stats.thesis_confirm import ThesisEvidence, thesis_confirm
from edp.wording import percent, typed
from edp.workflows.search.context import Array, Decision, Outcome, SearchContext
from edp.workflows.search.modules import MODULES
from edp.workflows.search.phases.base import PHASES, Course
from edp.workflows.search.phases.screening import baseline_of

METRICS = ("mae", "rmse", "p95", "p99")


class Confirmation:
    """Phase 3. Sound: a race with a clustered test; thesis: splits and seeds with a mixed model."""

    title = "confirmation"

    def trainings(self, context: SearchContext) -> int:
        """Were nothing dropped at an interim analysis; before the screening, with half of the modules."""
        spec, decided = context.spec, context.decided
        half = len(spec.modules or MODULES) // 2
        arms = len(decided["screening"].facts["passed"]) if "screening" in decided else half
        runs = int(decided["planning"].facts["runs"]) if "planning" in decided else spec.most_runs
        return (1 + arms) * runs * (spec.run_seeds if spec.mode == "thesis" else 1) if arms else 0

    def run(self, context: SearchContext) -> Course:
        """Trainings of the mode, and what is confirmed."""
        passed = list(context.decided["screening"].facts["passed"])
        if not passed:
            yield from ()
            return Decision("confirmation", {"confirmed": [], "evidence": []}, ("No module passed the screening.",))
        base = baseline_of(context)[0]
        arms = [base, *(context.network(base, [name]) for name in passed)]
        return (yield from (_thesis if context.spec.mode == "thesis" else _sound)(context, passed, arms))


def _sound(context: SearchContext, passed: list[str], arms: list[Table]) -> Course:
    """One interim analysis after the other; a dropped module is not trained any more."""
    runs = int(context.decided["planning"].facts["runs"])
    interim_analyses = tuple(analysis for analysis in INTERIM_ANALYSES if analysis.runs < runs)
    mask = context.folds(runs)
    scores = np.full((len(arms), runs, len(context.development)), np.nan)
    alive = list(range(len(arms)))
    start = 0
    for stop in (*(analysis.runs for analysis in interim_analyses), runs):
        outcomes = yield [order for arm in alive for order in context.orders(arms[arm], range(start, stop))]
        for index, arm in enumerate(alive):
            own = outcomes[index * (stop - start) : (index + 1) * (stop - start)]
            scores[arm, start:stop] = context.table(own)
        start = stop
        filled = fill_worst(scores[alive, :stop], mask[:stop])
        if stop < runs:
            hopeless = _hopeless(filled, mask[:stop], stop, interim_analyses)
            # The baseline (0) is never dropped: all others are held against it.
            alive = [0, *(arm for arm, out in zip(alive[1:], hopeless, strict=True) if not out)]
        if len(alive) == 1:
            # Nothing but the baseline is left: further runs would compare it with itself.
            break
    evidence = confirm(
        scores[:, :start],
        passed,
        # All modules that were screened count for the adjustment, not only those that passed.
        context.decided["screening"].facts["registered"],
        mask[:start],
        Rule(alpha=context.spec.alpha, least_gain=context.spec.least_gain, interim_analyses=interim_analyses),
    )
    return _decision(
        [_plain(module_evidence) for module_evidence in evidence],
        [module_evidence.module for module_evidence in evidence if module_evidence.confirmed],
        _texts(evidence),
    )


def _hopeless(filled: Array, mask: Mask, stop: int, interim_analyses: Sequence[InterimAnalysis]) -> list[bool]:
    """Which modules the interim analysis after `stop` runs drops."""
    level = next(analysis.drop_above for analysis in interim_analyses if analysis.runs == stop)
    # Sessions that no run has judged so far hold nothing.
    seen = mask.any(axis=0)
    p = clustered_t((filled[1:] - filled[0])[..., seen], mask[:, seen]).p
    return [bool(value > level) for value in np.atleast_1d(p)]


def _thesis(context: SearchContext, passed: list[str], arms: list[Table]) -> Course:
    runs, seeds = int(context.decided["planning"].facts["runs"]), context.spec.run_seeds
    outcomes = yield [
        order for arm in arms for seed in range(seeds) for order in context.orders(arm, range(runs), seed=seed)
    ]
    scores = _by_metric(context, outcomes, len(arms), seeds, runs)
    evidence = thesis_confirm(scores, passed, METRICS, context.spec.alpha)
    confirmed = [name for name in passed if any(entry.confirmed for entry in evidence if entry.module == name)]
    texts = [_thesis_text(name, [entry for entry in evidence if entry.module == name]) for name in passed]
    return _decision([asdict(entry) for entry in evidence], confirmed, texts)


def _by_metric(context: SearchContext, outcomes: Sequence[Outcome], arms: int, seeds: int, runs: int) -> Array:
    """``(metric, arm, split, seed)``; a failed training has the worst of its metric."""
    rows = [[outcome.mean(context.spec.horizon, metric) for outcome in outcomes] for metric in METRICS]
    scores = np.array(rows).reshape(len(METRICS), arms, seeds, runs).swapaxes(2, 3)
    for own in scores:
        # NaN would drop out of medians, and failing would look good.
        own[~np.isfinite(own)] = np.nanmax(np.where(np.isfinite(own), own, np.nan))
    return scores


def _decision(evidence: list[dict[str, Any]], confirmed: list[str], texts: list[str]) -> Decision:
    head = f"Confirmed: {', '.join(MODULES[name].title for name in confirmed) or 'no module'}."
    return Decision("confirmation", {"confirmed": confirmed, "evidence": evidence}, (head, *texts))


def _plain(evidence: ModuleEvidence) -> dict[str, Any]:
    return asdict(evidence)


def _texts(evidence: Sequence[ModuleEvidence]) -> list[str]:
    return [f"{MODULES[entry.module].title}: {entry.reason}." for entry in evidence]


def _thesis_text(name: str, evidence: Sequence[ThesisEvidence]) -> str:
    best = min(evidence, key=lambda entry: entry.adjusted)
    verdict = "confirmed" if any(entry.confirmed for entry in evidence) else "not confirmed"
    return (
        f"{MODULES[name].title}: {verdict}; on {best.metric} adjusted p {typed(best.adjusted, 2)}, "
        f"d_z {best.d_z:.2f}, wins {percent(best.stability)}."
    )


PHASES.register("confirmation")(Confirmation())
