"""Phase 4: the confirmed modules together, and the one evaluation on the test sessions (thesis 3.3.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.evaluation.study import Decision
from edp.evaluation.study_facts import ConfirmationFacts, RelativeChange, SynthesisFacts
from edp.stats.clustered import clustered_t
from edp.wording import behind, percent, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.modules import title_of
from edp.workflows.search.phases.base import PHASES, Course, relative_change
from edp.workflows.search.phases.joint import ask_together, winner_of
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import SCORES, Outcome, TrainingRequest


class Synthesis:
    """Phase 4."""

    title = "synthesis"

    def trainings(self, context: SearchContext) -> int:
        """Count the questions, and the long trainings of both arms."""
        return context.spec.synthesis.trials * context.spec.trial_runs + 2 * context.spec.run_seeds

    def run(self, context: SearchContext) -> Course:
        """Tune modules and rates together; train the best and the baseline at full length, and evaluate both once."""
        confirmed = list(context.facts(ConfirmationFacts).confirmed)
        switches = [*confirmed, *context.spec.toggles]
        base, values, _ = baseline_of(context)
        # All confirmed modules, and none of them: the sampler begins with both ends.
        starts = [Trial(0, values, tuple(modules)) for modules in ([confirmed, []] if confirmed else [[]])]
        if context.spec.mode == "thesis":  # whose phase 4 has no warm start (3.3.5)
            starts = []
        answers = yield from ask_together(context, "synthesis", switches, context.spec.synthesis.trials, starts)
        winner = winner_of(context, "synthesis", switches, answers)
        arms = {"synthesis": Arm(winner.settings), "baseline": base}
        outcomes = yield [order for arm in arms.values() for order in final_orders(context, arm)]
        facts = SynthesisFacts(
            **vars(winner),
            test=judged(context, list(arms), outcomes),
            test_gain=gained(context, outcomes),
            antagonistic=tuple(name for name in confirmed if name not in winner.modules),
        )
        return self.decide(context, facts)

    def decide(self, context: SearchContext, facts: SynthesisFacts) -> Decision:
        """Return the selected modules, counterproductive combinations, and the result on the test sessions."""
        names = ", ".join(map(title_of, facts.modules)) or "no module"
        sentences = [f"Best together: {names}; {typed(facts.score, 3)}{behind(context.unit)} on development sessions."]
        sentences += facts.said_of_pruned
        if facts.antagonistic:
            left = ", ".join(map(title_of, facts.antagonistic))
            sentences.append(f"Confirmed alone, but not wanted together: {left}.")
        scores = (facts.test[arm]["composite"] for arm in ("synthesis", "baseline"))
        failed, unit = "no score, since a training failed", behind(context.unit)
        ours, base = (failed if score is None else typed(score, 3) + unit for score in scores)
        gain = facts.test_gain
        interval = "" if gain is None else f"; {percent(gain.change, signed=True)}, p {typed(gain.p, 2)}"
        sentences.append(
            f"On {len(context.test)} test sessions, opened once: {ours}, the baseline {base} (composite score, mean of "
            f"{context.spec.run_seeds} seeds{interval})."
        )
        return Decision("synthesis", facts, tuple(sentences))


def final_orders(context: SearchContext, arm: Arm) -> list[TrainingRequest]:
    """Return trainings on all development sessions at full length, evaluated on the test sessions; one per seed.

    Several epochs are validated by the development sessions that evaluate the first run, which then do not train: the
    test sessions have no say.
    """
    train = context.development
    validation: tuple[str, ...] = ()
    if context.spec.epochs > 1:
        # With several epochs the sessions of a fold choose the best epoch; test sessions never do.
        first = context.orders(arm, [0])[0]
        train, validation = first.train, first.judged
    updates = context.spec.final_updates
    return [
        context.order(arm, train, context.test, context.seed("final", seed), updates, validation)
        for seed in range(context.spec.run_seeds)
    ]


def judged(
    context: SearchContext, arms: Sequence[str], outcomes: Sequence[Outcome]
) -> dict[str, dict[str, float | None]]:
    """Return means over seeds of each score on the test sessions, by arm; None where a training did not end well."""
    seeds = context.spec.run_seeds
    arm_scores: dict[str, dict[str, float | None]] = {}
    for index, arm in enumerate(arms):
        own = outcomes[index * seeds : (index + 1) * seeds]
        means = {name: float(np.mean([o.mean(context.spec.horizon, name) for o in own])) for name in SCORES}
        arm_scores[arm] = {name: value if np.isfinite(value) else None for name, value in means.items()}
    return arm_scores


def gained(context: SearchContext, outcomes: Sequence[Outcome]) -> RelativeChange | None:
    """Return the first arm's change against the second on the test sessions, clustered by session and seed.

    None with one test session, one seed, or a training that did not end well.
    """
    scores = np.array([[o.score(name, context.spec.horizon) for name in context.test] for o in outcomes])
    arms = scores.reshape(2, context.spec.run_seeds, len(context.test))
    # A clustered test needs two sessions and two seeds.
    if min(arms.shape[1:]) < 2 or not np.isfinite(arms).all():
        return None
    return relative_change(clustered_t(arms[0] - arms[1]), float(arms[1].mean()))


PHASES.register("synthesis")(Synthesis())
