"""Phase 2.5: how many runs a confirmation needs (thesis 3.3.3.1)."""

from __future__ import annotations

from edp.errors import count_of
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import CalibrationFacts, IsolationFacts, ScreeningFacts, SoundPlanning, ThesisPlanning
from edp.stats.power import plan_runs
from edp.stats.thesis_power import ThesisPlan, thesis_plan
from edp.wording import behind, typed
from edp.workflows.search.context import SearchContext
from edp.workflows.search.phases.base import PHASES, Course


class Planning:
    """Phase 2.5: planning without training."""

    title = "power"

    def trainings(self, context: SearchContext) -> int:
        """Return 0: planning trains no network."""
        return 0

    def run(self, context: SearchContext) -> Course:
        """Decide at once."""
        yield from ()
        return _thesis(context) if context.spec.mode == "thesis" else _sound(context)


def _sound(context: SearchContext) -> Decision:
    """Plan by the closed form for the clustered test, at the level that a single true module must pass."""
    spec = context.spec
    facts = context.facts(IsolationFacts)
    mean = facts.mean_scores[facts.features]
    # At least one, so that the level stays defined where nothing is registered.
    modules = max(1, len(context.facts(ScreeningFacts).registered))
    plan = plan_runs(
        spec.planning.min_effect * mean,
        facts.variance,
        len(context.development),
        folds=spec.folds,
        # Bonferroni's level: the strictest that a single true module has to pass.
        alpha=spec.confirmation.alpha / modules,
        target=spec.planning.power,
        most=spec.planning.max_runs,
    )
    # Whole repeats of the folds, even where the power is not reached.
    runs = plan.runs or spec.planning.max_runs - spec.planning.max_runs % spec.folds
    effect = typed(100 * spec.planning.min_effect)
    sentences = [f"To see {effect} % of {typed(mean, 3)}{behind(context.unit)}: {plan.reason}."]
    if plan.runs is None:
        sentences.append(
            f"{count_of(runs, 'run')} are made nevertheless; effects below what they can show will be missed."
        )
    return Decision("planning", SoundPlanning(**{**vars(plan), "runs": runs, "enough": plan.runs}), tuple(sentences))


def _thesis(context: SearchContext) -> Decision:
    """Return J after eq. 3.42 on the mean absolute error.

    The standard deviation between seeds is the largest of all backbones (3.3.1); the error of which a share is to be
    seen is that of the baseline's backbone in phase 0. Both with the feature set that went on.
    """
    spec, planning = context.spec, context.spec.planning
    isolation, backbone = context.facts(IsolationFacts), context.facts(CalibrationFacts).backbone
    arms = {name: isolation.arms[f"{name} {isolation.features}"].mae for name in spec.backbones}
    sigma = max(arm.seed or 0.0 for arm in arms.values())
    mean = arms[backbone].mean
    # Seeds that agree to the last digit leave nothing to plan for; two splits are the least of a mixed model.
    plan = ThesisPlan(splits=2, simulated=None, analytical=0.0)
    if sigma > 0.0:
        plan = thesis_plan(
            mean,
            sigma,
            spec.run_seeds,
            share=planning.min_effect,
            alpha=spec.confirmation.alpha,
            power=planning.power,
        )
    runs = min(plan.splits or 2, planning.max_runs)
    text = (
        f"J = {plan.splits} splits of {spec.run_seeds} seeds after eq. 3.42 (seeds differ by {typed(sigma, 3)}"
        f"{behind(context.unit)}, {typed(100 * planning.min_effect)} % of an MAE of {typed(mean, 3)} are to be "
        f"seen); {runs} are made."
    )
    return Decision("planning", ThesisPlanning(**vars(plan), runs=runs, mae=mean, sigma_seed=sigma), (text,))


PHASES.register("planning")(Planning())
