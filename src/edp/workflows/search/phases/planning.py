"""Phase 2.5: how many runs a confirmation needs (thesis 3.3.3.1)."""

from __future__ import annotations

from dataclasses import asdict

from edp.errors import count_of
from edp.stats.power import plan_runs
from edp.stats.thesis_power import thesis_plan
from edp.stats.variance import PairedVariance
from edp.wording import behind, typed
from edp.workflows.search.context import Decision, SearchContext
from edp.workflows.search.phases.base import PHASES, Course


class Planning:
    """Phase 2.5: nothing is trained."""

    title = "power"

    def trainings(self, context: SearchContext) -> int:
        """None."""
        return 0

    def run(self, context: SearchContext) -> Course:
        """Decide at once."""
        yield from ()
        return _thesis(context) if context.spec.mode == "thesis" else _sound(context)


def _sound(context: SearchContext) -> Decision:
    """Closed form for the clustered test, at the level that a single true module has to pass."""
    spec = context.spec
    facts = context.decided["isolation"].facts
    mean = facts["mean_scores"][facts["features"]]
    # At least one, so that the level stays defined where nothing is registered.
    modules = max(1, len(context.decided["screening"].facts["registered"]))
    plan = plan_runs(
        spec.least_effect * mean,
        PairedVariance(**facts["variance"]),
        len(context.development),
        folds=spec.folds,
        # Bonferroni's level: the strictest that a single true module has to pass.
        alpha=spec.alpha / modules,
        target=spec.power,
        most=spec.most_runs,
    )
    # Whole repeats of the folds, even where the power is not reached.
    runs = plan.runs or spec.most_runs - spec.most_runs % spec.folds
    sentences = [f"To see {typed(100 * spec.least_effect)} % of {typed(mean, 3)}{behind(context.unit)}: {plan.reason}."]
    if plan.runs is None:
        sentences.append(
            f"{count_of(runs, 'run')} are made nevertheless; effects below what they can show will be missed."
        )
    return Decision("planning", {**asdict(plan), "runs": runs, "enough": plan.runs}, tuple(sentences))


def _thesis(context: SearchContext) -> Decision:
    """J after eq. 3.42 on the mean absolute error.

    The standard deviation between seeds is the largest of all backbones (3.3.1); the error of which a share is to be
    seen is that of the baseline's backbone in phase 0. Both with the feature set that went on.
    """
    spec = context.spec
    features = context.decided["isolation"].facts["features"]
    backbone = context.decided["calibration"].facts["backbone"]
    arms = {name: arm["mae"] for name, arm in context.decided["isolation"].facts["arms"].items()}
    sigma = max((arms[f"{one} {features}"]["seed"] or 0.0) for one in spec.backbones)
    mean = arms[f"{backbone} {features}"]["mean"]
    if sigma <= 0.0:
        # Seeds that agree to the last digit leave nothing to plan for; two splits are the least of a mixed model.
        plan = {"splits": 2, "simulated": None, "analytical": 0.0}
    else:
        power_plan = thesis_plan(
            mean, sigma, spec.run_seeds, share=spec.least_effect, alpha=spec.alpha, power=spec.power
        )
        plan = asdict(power_plan)
    runs = min(int(plan["splits"] or 2), spec.most_runs)
    text = (
        f"J = {plan['splits']} splits of {spec.run_seeds} seeds after eq. 3.42 (seeds differ by {typed(sigma, 3)}"
        f"{behind(context.unit)}, {typed(100 * spec.least_effect)} % of an MAE of {typed(mean, 3)} are to be seen); "
        f"{runs} "
        "are made."
    )
    return Decision("planning", {**plan, "runs": runs, "mae": mean, "sigma_seed": sigma}, (text,))


PHASES.register("planning")(Planning())
