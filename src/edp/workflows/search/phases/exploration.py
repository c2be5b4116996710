"""Phase 5: all modules at once, from the winner of phase 4 on (thesis 3.3.6, eq. 3.43)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from edp.errors import count_of
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import ExplorationFacts, JointFacts, SynthesisFacts
from edp.stats.clustered import clustered_t
from edp.stats.paired import fill_worst
from edp.wording import percent, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.modules import fitting, options_of, title_of
from edp.workflows.search.phases.base import PHASES, Course, relative_change
from edp.workflows.search.phases.joint import ask_together, winner_of
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.space import Value
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import Outcome


class Exploration:
    """Phase 5: compare its winner with the winner of phase 4 on new folds."""

    title = "exploration"

    def trainings(self, context: SearchContext) -> int:
        """Count the questions, and the trainings of both winners on fresh folds."""
        return context.spec.exploration.trials * context.spec.trial_runs + 2 * len(fresh_runs(context))

    def run(self, context: SearchContext) -> Course:
        """Ask about all modules and options of active ones; train both winners on fresh folds with equal seeds."""
        spec = context.spec
        base = baseline_of(context).arm
        free = fitting(base, context.channels, spec.modules)
        earlier = context.facts(SynthesisFacts)
        # The winner of phase 4 is the warm start: phase 5 is to find at least that.
        starts = [Trial(0, earlier.values, earlier.modules)]
        options = {name: options_of(base, name, context.shaped) for name in free}
        switches = [*free, *spec.toggles]
        answers = yield from ask_together(context, "exploration", switches, spec.exploration.trials, starts, options)
        winner = winner_of(context, "exploration", switches, answers)
        runs = fresh_runs(context)
        arms = (Arm(earlier.settings), Arm(winner.settings))
        outcomes = yield [order for arm in arms for order in context.orders(arm, runs)]
        searched = {key: tuple(choice.options) for own in options.values() for key, choice in own.items()}
        return self.decide(context, winner, searched, outcomes)

    def decide(
        self,
        context: SearchContext,
        winner: JointFacts,
        options: Mapping[str, tuple[Value, ...]],
        outcomes: Sequence[Outcome],
    ) -> Decision:
        """Choose the teacher: the winner of phase 5 if new folds confirm it, otherwise the winner of phase 4."""
        size = len(outcomes) // 2
        # The last rows of the mask are the fresh runs.
        mask = context.folds(fresh_runs(context)[-1] + 1)[-size:]
        seen = mask.any(axis=0)
        scores = np.stack([context.table(part)[:, seen] for part in (outcomes[:size], outcomes[size:])])
        filled = fill_worst(scores, mask[:, seen])
        test = clustered_t(filled[1] - filled[0], mask[:, seen])
        fresh = [float(own[mask[:, seen]].mean()) for own in filled]
        comparison = relative_change(test, fresh[0])
        # Both: a gain, and one that chance hardly makes.
        better = comparison.change < 0 and comparison.p < context.spec.confirmation.alpha
        names = ", ".join(map(title_of, winner.modules)) or "no module"
        facts = ExplorationFacts(
            **vars(winner),
            **vars(comparison),
            options=options,
            fresh={"synthesis": fresh[0], "exploration": fresh[1]},
            runs=size,
            teacher="exploration" if better else "synthesis",
            teacher_settings=winner.settings if better else context.facts(SynthesisFacts).settings,
        )
        verdict = "it is the teacher" if better else "the winner of phase 4 stays the teacher"
        sentences = (
            f"Best of {len(winner.trials)} questions about all modules: {names}.",
            f"Against the winner of phase 4 on {count_of(size, 'fresh run')}: "
            f"{percent(comparison.change, signed=True)} (one-sided p {typed(comparison.p, 2)}); {verdict}.",
            *winner.said_of_pruned,
        )
        return Decision("exploration", facts, sentences)


def fresh_runs(context: SearchContext) -> range:
    """Return two repeats of the folds behind all that phases 0 to 4 may have used."""
    spec = context.spec
    used = max(spec.planning.max_runs, spec.isolation.runs, spec.trial_runs, spec.screening.repeats)
    # Rounded up to whole repeats, so that the fresh folds are complete.
    start = -(-used // spec.folds) * spec.folds
    return range(start, start + 2 * spec.folds)


PHASES.register("exploration")(Exploration())
