"""Phase 4: the confirmed modules together, and the one evaluation on the test sessions (thesis 3.3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from edp.config.experiment import Table
from edp.stats.clustered import clustered_t
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.modules import title_of
from edp.workflows.search.phases.base import PHASES, Course, changed
from edp.workflows.search.phases.joint import ask_together, winner_of
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.trainings import SCORES, TrainingRequest


class Synthesis:
    """Phase 4."""

    title = "synthesis"

    def trainings(self, ground: SearchContext) -> int:
        """The questions, and both arms at length."""
        return ground.spec.joint_trials * ground.spec.trial_runs + 2 * ground.spec.run_seeds

    def run(self, ground: SearchContext) -> Course:
        """Tune modules and rates together; then train the best and the baseline at length and judge both once."""
        confirmed = list(ground.decided["confirmation"].facts["confirmed"])
        switches = [*confirmed, *ground.spec.toggles]
        base, values, _ = baseline_of(ground)
        starts = [(values, confirmed), (values, [])] if confirmed else [(values, [])]
        if ground.spec.mode == "thesis":  # whose phase 4 has no warm start (3.3.5)
            starts = []
        answers = yield from ask_together(ground, "synthesis", switches, ground.spec.joint_trials, starts)
        facts = winner_of(ground, "synthesis", switches, answers)
        arms = {"synthesis": facts["settings"], "baseline": base}
        outcomes = yield [order for settings in arms.values() for order in final_orders(ground, settings)]
        facts["test"] = judged(ground, list(arms), outcomes)
        facts["test_gain"] = gained(ground, outcomes)
        return self.decide(ground, confirmed, facts)

    def decide(self, ground: SearchContext, confirmed: Sequence[str], facts: dict[str, Any]) -> Decision:
        """What stays, what works against the others, and what the test sessions say."""
        facts["antagonistic"] = [name for name in confirmed if name not in facts["modules"]]
        names = ", ".join(map(title_of, facts["modules"])) or "no module"
        sentences = [f"Best together: {names}; {facts['score']:.3g} {ground.unit} on development sessions."]
        sentences += facts["said_of_pruned"]
        if facts["antagonistic"]:
            left = ", ".join(map(title_of, facts["antagonistic"]))
            sentences.append(f"Confirmed alone, but not wanted together: {left}.")
        test = facts["test"]
        ours, base = (_shown(test[arm]["composite"], ground.unit) for arm in ("synthesis", "baseline"))
        gain = facts["test_gain"]
        interval = "" if gain is None else f"; {100 * gain['change']:+.2f} %, p {gain['p']:.2g}"
        sentences.append(
            f"On {len(ground.test)} test sessions, opened once: {ours}, the baseline {base} (composite score, mean of "
            f"{ground.spec.run_seeds} seeds{interval})."
        )
        return Decision("synthesis", facts, tuple(sentences))


def final_orders(ground: SearchContext, settings: Table) -> list[TrainingRequest]:
    """Trainings on all development sessions at full length, judged on the test sessions; an order a seed.

    Several epochs are validated by the development sessions that judge the first run, which then do not train: the test
    sessions have no say.
    """
    train = ground.development
    validation: tuple[str, ...] = ()
    if ground.spec.epochs > 1:
        first = ground.orders(settings, [0])[0]
        train, validation = first.train, first.judged
    return [
        TrainingRequest(
            settings,
            ground.source,
            train,
            ground.test,
            ground.seed("final", seed),
            ground.spec.final_updates,
            **ground.several(validation),
        )
        for seed in range(ground.spec.run_seeds)
    ]


def judged(
    ground: SearchContext, arms: Sequence[str], outcomes: Sequence[Outcome]
) -> dict[str, dict[str, float | None]]:
    """Means over seeds of each score on the test sessions, by arm; None where a training did not end well."""
    seeds = ground.spec.run_seeds
    arm_scores: dict[str, dict[str, float | None]] = {}
    for index, arm in enumerate(arms):
        own = outcomes[index * seeds : (index + 1) * seeds]
        means = {name: float(np.mean([o.mean(ground.spec.horizon, name) for o in own])) for name in SCORES}
        arm_scores[arm] = {name: value if np.isfinite(value) else None for name, value in means.items()}
    return arm_scores


def gained(ground: SearchContext, outcomes: Sequence[Outcome]) -> dict[str, float] | None:
    """The first arm against the second on the test sessions, clustered by session and seed.

    None with one test session, one seed, or a training that did not end well.
    """
    scores = np.array([[o.score(name, ground.spec.horizon) for name in ground.test] for o in outcomes])
    arms = scores.reshape(2, ground.spec.run_seeds, len(ground.test))
    if min(arms.shape[1:]) < 2 or not np.isfinite(arms).all():
        return None
    return changed(clustered_t(arms[0] - arms[1]), float(arms[1].mean()))


def _shown(score: float | None, unit: str) -> str:
    return "no score, since a training failed" if score is None else f"{score:.3g} {unit}"


PHASES.register("synthesis")(Synthesis())
