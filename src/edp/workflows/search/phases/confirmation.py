"""Phase 3: modules against the baseline over repeated folds (thesis 3.3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.evaluation.study import Decision, facts_of_kind
from edp.evaluation.study_facts import PlanningFacts, ScreeningFacts, SoundConfirmation, ThesisConfirmation
from edp.stats.checks import Mask
from edp.stats.clustered import clustered_t
from edp.stats.confirm import Rule, confirm
from edp.stats.paired import fill_worst
from edp.stats.race import INTERIM_ANALYSES, InterimAnalysis
from edp.stats.thesis_confirm import ThesisEvidence, thesis_confirm
from edp.wording import percent, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import Array, SearchContext
from edp.workflows.search.modules import MODULES
from edp.workflows.search.phases.base import PHASES, Course
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.trainings import Outcome

METRICS = ("mae", "rmse", "p95", "p99")


class Confirmation:
    """Phase 3. Sound: a race with a clustered test; thesis: splits and seeds with a mixed model."""

    title = "confirmation"

    def trainings(self, context: SearchContext) -> int:
        """Count the trainings without interim drops; before the screening, with half of the modules."""
        spec, decisions = context.spec, list(context.decided.values())
        screening, planning = facts_of_kind(decisions, ScreeningFacts), facts_of_kind(decisions, PlanningFacts)
        half = len(spec.modules or MODULES) // 2
        arms = half if screening is None else len(screening.passed)
        runs = spec.planning.max_runs if planning is None else planning.runs
        return (1 + arms) * runs * (spec.run_seeds if spec.mode == "thesis" else 1) if arms else 0

    def run(self, context: SearchContext) -> Course:
        """Train in the mode of the search, and confirm modules."""
        passed = list(context.facts(ScreeningFacts).passed)
        if not passed:
            yield from ()
            facts = (ThesisConfirmation if context.spec.mode == "thesis" else SoundConfirmation)(
                confirmed=(), evidence=()
            )
            return Decision("confirmation", facts, ("No module passed the screening.",))
        base = baseline_of(context).arm
        arms = [base, *(context.network(base, [name]) for name in passed)]
        return (yield from (_thesis if context.spec.mode == "thesis" else _sound)(context, passed, arms))


def _sound(context: SearchContext, passed: list[str], arms: list[Arm]) -> Course:
    """Return one interim analysis after the other; a dropped module is not trained any more."""
    runs = context.facts(PlanningFacts).runs
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
    rules = context.spec.confirmation
    evidence = confirm(
        scores[:, :start],
        passed,
        # All modules that were screened count for the adjustment, not only those that passed.
        context.facts(ScreeningFacts).registered,
        mask[:start],
        Rule(alpha=rules.alpha, least_gain=rules.min_gain, interim_analyses=interim_analyses),
    )
    confirmed = tuple(entry.module for entry in evidence if entry.confirmed)
    texts = (f"{MODULES[entry.module].title}: {entry.reason}." for entry in evidence)
    facts = SoundConfirmation(confirmed=confirmed, evidence=tuple(evidence))
    return Decision("confirmation", facts, (_headline(confirmed), *texts))


def _hopeless(filled: Array, mask: Mask, stop: int, interim_analyses: Sequence[InterimAnalysis]) -> list[bool]:
    """Return for each module whether the interim analysis after `stop` runs drops it."""
    level = next(analysis.drop_above for analysis in interim_analyses if analysis.runs == stop)
    # Sessions that no run has judged so far hold nothing.
    seen = mask.any(axis=0)
    p = clustered_t((filled[1:] - filled[0])[..., seen], mask[:, seen]).p
    return [bool(value > level) for value in np.atleast_1d(p)]


def _thesis(context: SearchContext, passed: list[str], arms: list[Arm]) -> Course:
    runs, seeds = context.facts(PlanningFacts).runs, context.spec.run_seeds
    outcomes = yield [
        order for arm in arms for seed in range(seeds) for order in context.orders(arm, range(runs), seed=seed)
    ]
    scores = _collect_scores(context, outcomes, len(arms), seeds, runs)
    evidence = thesis_confirm(scores, passed, METRICS, context.spec.confirmation.alpha)
    confirmed = tuple(name for name in passed if any(entry.confirmed for entry in evidence if entry.module == name))
    texts = (_thesis_text(name, [entry for entry in evidence if entry.module == name]) for name in passed)
    facts = ThesisConfirmation(confirmed=confirmed, evidence=tuple(evidence))
    return Decision("confirmation", facts, (_headline(confirmed), *texts))


def _collect_scores(context: SearchContext, outcomes: Sequence[Outcome], arms: int, seeds: int, runs: int) -> Array:
    """Return ``(metric, arm, split, seed)``; a failed training has the worst of its metric."""
    rows = [[outcome.mean(context.spec.horizon, metric) for outcome in outcomes] for metric in METRICS]
    scores = np.array(rows).reshape(len(METRICS), arms, seeds, runs).swapaxes(2, 3)
    for own in scores:
        # NaN would drop out of medians, and failing would look good.
        own[~np.isfinite(own)] = np.nanmax(np.where(np.isfinite(own), own, np.nan))
    return scores


def _headline(confirmed: Sequence[str]) -> str:
    return f"Confirmed: {', '.join(MODULES[name].title for name in confirmed) or 'no module'}."


def _thesis_text(name: str, evidence: Sequence[ThesisEvidence]) -> str:
    best = min(evidence, key=lambda entry: entry.adjusted)
    verdict = "confirmed" if any(entry.confirmed for entry in evidence) else "not confirmed"
    return (
        f"{MODULES[name].title}: {verdict}; on {best.metric} adjusted p {typed(best.adjusted, 2)}, "
        f"d_z {best.d_z:.2f}, wins {percent(best.stability)}."
    )


PHASES.register("confirmation")(Confirmation())
