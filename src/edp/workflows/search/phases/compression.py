"""Phase 6: long training of the teacher, smaller networks, one evaluation on the second test set (thesis 3.3.7)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from statistics import fmean

from edp.errors import ConfigError
from edp.evaluation.compression import CompressedRow
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import ComparingSessions, ExplorationFacts, SecondTest, SmallerFacts, SmallerNetwork
from edp.networks.narrow import width_of
from edp.networks.predictor import build_model
from edp.training.bundle import blank_scaler
from edp.wording import percent
from edp.workflows.compression import FORMATS, CompressionRequest
from edp.workflows.compression.pipeline import TEACHER, NetworkResult, choose, relative_error, rows_of
from edp.workflows.compression.planning import CompressionPlan, make_plan
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.phases.base import PHASES, Course
from edp.workflows.search.smaller import Recipe
from edp.workflows.search.trainings import Outcome, TrainingRequest

NAME = "compression"


class CompressionPhase:
    """Phase 6: compare networks on development sessions outside the training, and report on the second test set."""

    title = NAME

    def trainings(self, context: SearchContext) -> int:
        """Return teacher, at most three networks a width, and teacher and choice once more on the second test set."""
        spec = context.spec.compression
        if not spec.enabled:
            return 0
        if "exploration" in context.decided:
            try:
                return plan_of(context, teacher_of(context)).trainings + 3
            except ConfigError:
                return 1
        widths = len(spec.units) or len(spec.width_fractions) + len(spec.formats or FORMATS) - 1
        return 3 * widths + 3

    def run(self, context: SearchContext) -> Course:
        """Train teacher and students of each width, round the better ones, evaluate the choice on the test set."""
        if not context.spec.compression.enabled:
            yield from ()
            return Decision(NAME, SmallerFacts(on=False), ("Left out: search.compression.enabled is false.",))
        teacher_arm = teacher_of(context)
        # The teacher first: all others are made of it.
        (first,) = yield [order_of(context, teacher_arm, recipe_of(context))]
        if first.result is None:
            return _nothing(
                context, f"The teacher's training at length did not end well ({first.message or first.status})."
            )
        try:
            plan = plan_of(context, teacher_arm)
        except ConfigError as error:
            return _nothing(context, f"No network was made: {error}.")
        teacher = NetworkResult.from_json(first.result)
        requests = [order for orders in plan.orders.values() for order in orders]
        results = yield from _make(context, teacher_arm, requests)
        if plan.rounds:
            # The mean over horizons of the MAE itself, not over the teacher's as in the rows.
            errors = {order: fmean(one["mae"] for one in result.plain.values()) for order, result in results.items()}
            results |= yield from _make(context, teacher_arm, plan.to_round(errors))
        networks: list[tuple[CompressionRequest | None, NetworkResult]] = [(None, teacher), *results.items()]
        rows = [(order, row) for order, result in networks for row in rows_of(order, result, teacher.plain)]
        front, chosen = choose([row for _, row in rows])
        facts = SmallerFacts(
            budget=context.spec.compression.budget,
            sessions=ComparingSessions(context.training, context.validation),
            second=context.second,
            rows=tuple(_network(order, row) for order, row in rows),
            front=tuple(front),
            chosen=chosen,
            notes=tuple(plan.notes),
        )
        sentences = [f"{len(rows)} networks and formats were compared on {', '.join(context.validation)}."]
        budget = context.spec.compression.budget
        if chosen is None:
            # The second test set is not opened where nothing fits.
            return Decision(NAME, facts, (*sentences, f"None of them fits the budget '{budget.name}'."))
        order, row = rows[chosen]
        usage = row.resource_usage
        sentences.append(
            f"Chosen for '{budget.name}': {row.name} with {usage.parameter_bytes:,} bytes of parameters "
            f"and {usage.cycles[2]:,} cycles a tick; its error there is {percent(row.error - 1, signed=True)} "
            "against the teacher's."
        )
        # Teacher and choice alone are judged there: more evaluations would make it a validation set.
        final = [
            replace(recipe_of(context), final="float32"),
            replace(recipe_of(context, order), final=row.number_format),
        ]
        outcomes = yield [order_of(context, teacher_arm, recipe, context.second) for recipe in final]
        scores = {
            who: result.scores
            for who, recipe, outcome in zip((TEACHER, "chosen"), final, outcomes, strict=True)
            if outcome.result is not None
            if (result := NetworkResult.from_json(outcome.result).formats.get(recipe.final)) is not None
        }
        if len(scores) < len(final):
            sentences.append("A network could not be judged on the second test set.")
            return Decision(NAME, facts, tuple(sentences))
        ratio = relative_error(scores["chosen"], scores[TEACHER])
        sentences.append(
            f"On the second test set ({', '.join(context.second)}), opened for these two alone: "
            f"{percent(ratio - 1, signed=True)} against the teacher's error."
        )
        return Decision(NAME, replace(facts, held_out_test=SecondTest(scores, ratio)), tuple(sentences))


def _make(
    context: SearchContext, teacher: Arm, requests: Sequence[CompressionRequest]
) -> Generator[list[TrainingRequest], list[Outcome], dict[CompressionRequest, NetworkResult]]:
    """Have networks made; those that were not trained to their end are left out."""
    outcomes = yield [order_of(context, teacher, recipe_of(context, request)) for request in requests]
    return {
        request: NetworkResult.from_json(outcome.result)
        for request, outcome in zip(requests, outcomes, strict=True)
        if outcome.result is not None
    }


def _network(order: CompressionRequest | None, row: CompressedRow) -> SmallerNetwork:
    return SmallerNetwork(
        name=row.name,
        recipe=row.recipe,
        units=None if order is None else order.units,
        pruned=order is not None and order.begins_pruned,
        rounded=order is not None and order.rounding is not None,
        format=row.number_format,
        resource_usage=row.resource_usage,
        over=row.over,
        scores=row.scores,
        before=row.before,
        error=row.error,
    )


def teacher_of(context: SearchContext) -> Arm:
    """Return the winner of the search."""
    return Arm(context.facts(ExplorationFacts).teacher_settings)


def recipe_of(context: SearchContext, order: CompressionRequest | None = None) -> Recipe:
    """Return the recipe of a request's network under the settings of this search.

    That of the teacher without a request.
    """
    spec = context.spec.compression
    steps = spec.updates or context.spec.final_updates
    recipe = Recipe(steps, spec.formats or tuple(FORMATS), spec.budget, context.validation)
    if order is None:
        return recipe
    return replace(recipe, units=order.units, pruned=order.begins_pruned, rounded=order.rounding is not None)


def order_of(context: SearchContext, teacher: Arm, recipe: Recipe, judged: Sequence[str] = ()) -> TrainingRequest:
    """Return the request that makes and evaluates a recipe's network, by default on the comparing sessions."""
    validation, updates = context.validation, context.spec.final_updates
    sessions = tuple(judged) or validation
    order = context.order(teacher, context.training, sessions, context.seed(NAME), updates, validation)
    return replace(order, recipe=recipe.to_json())


def plan_of(context: SearchContext, teacher: Arm) -> CompressionPlan:
    """Return the plan of the smaller networks.

    Raises:
        ConfigError: a budget that no network of this kind meets.
    """
    spec = context.spec.compression
    experiment = teacher.experiment("of the search")
    task = experiment.task.resolve(100.0, context.channels, experiment.model.physics)
    network = build_model(task, experiment.model, blank_scaler(task), seed=0)
    # Widths beyond the teacher's are left out here: settings are written before its width is known.
    units = [width for width in spec.units if width <= width_of(experiment.model)]
    return make_plan(network, spec.budget, units, spec.formats, shares=spec.width_fractions)


def _nothing(context: SearchContext, why: str) -> Decision:
    facts = SmallerFacts(budget=context.spec.compression.budget, second=context.second, notes=(why,))
    return Decision(NAME, facts, (why, "The second test set stays closed."))


PHASES.register(NAME)(CompressionPhase())
