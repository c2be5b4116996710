"""Phase 6: the teacher at length, smaller networks of it, and one evaluation on the second test set (thesis 3.3.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from edp.config.experiment import Experiment, Table, build
from edp.errors import ConfigError
from edp.networks.narrow import width_of
from edp.networks.predictor import build_model
from edp.stats.pareto import pareto
from edp.training.bundle import blank_scaler
from edp.wording import percent
from edp.workflows.compression import FORMATS
from edp.workflows.compression.judged import recipe_text, relative
from edp.workflows.compression.planning import CompressionPlan, make_plan
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.phases.base import PHASES, Course
from edp.workflows.search.smaller import Recipe
from edp.workflows.search.trainings import TrainingRequest

NAME = "compression"
Row = dict[str, Any]


@dataclass
class _Made:
    """A network and what came of it."""

    recipe: Recipe
    outcome: Outcome

    @property
    def error(self) -> float:
        """MAE in float32, the mean over horizons; infinite where it was not trained to its end."""
        result = self.outcome.result
        # A failed network must never be the least.
        if result is None:
            return float("inf")
        return sum(float(scores["mae"]) for scores in result["plain"].values()) / len(result["plain"])


class CompressionPhase:
    """Phase 6. Networks are compared on development sessions that do not train; the second test set chooses nothing."""

    title = NAME

    def trainings(self, context: SearchContext) -> int:
        """Teacher, at most three networks a width, and teacher and choice once more on the second test set."""
        spec = context.spec.compression
        if not spec.on:
            return 0
        if "exploration" in context.decided:
            try:
                return plan_of(context, teacher_settings(context)).trainings + 3
            except ConfigError:
                return 1
        widths = len(spec.units) or len(spec.shares) + len(spec.formats or FORMATS) - 1
        return 3 * widths + 3

    def run(self, context: SearchContext) -> Course:
        """Teacher; students of each width; the better of each with rounded numbers; the choice on the test set."""
        if not context.spec.compression.on:
            yield from ()
            return Decision(NAME, {"on": False}, ("Left out: search.compression.on is false.",))
        settings = teacher_settings(context)
        # The teacher first: all others are made of it.
        (first,) = yield [order_of(context, settings, recipe_of(context))]
        teacher = _Made(recipe_of(context), first)
        if first.result is None:
            return _nothing(
                context, f"The teacher's training at length did not end well ({first.message or first.status})."
            )
        try:
            plan = plan_of(context, settings)
        except ConfigError as error:
            return _nothing(context, f"No network was made: {error}.")
        networks = [teacher]
        recipes = [recipe_of(context, order.units, order.pruned) for orders in plan.orders.values() for order in orders]
        outcomes = yield [order_of(context, settings, recipe) for recipe in recipes]
        networks += map(_Made, recipes, outcomes)
        if plan.rounds:
            # The better recipe of each width is rounded; rounding both would double the trainings.
            better = [replace(_better(networks, units).recipe, rounded=True) for units in plan.orders]
            outcomes = yield [order_of(context, settings, recipe) for recipe in better]
            networks += map(_Made, better, outcomes)
        rows = rows_of(context, teacher, networks)
        chosen = chosen_of(rows)
        if chosen is None:
            # The second test set is not opened where nothing fits.
            return self.decide(context, plan, rows, None, ())
        # Teacher and choice alone are judged there: more evaluations would make it a validation set.
        final = [replace(recipe_of(context), final="float32"), _final(context, rows[chosen])]
        outcomes = yield [order_of(context, settings, recipe, context.second) for recipe in final]
        return self.decide(context, plan, rows, chosen, outcomes)

    def decide(
        self,
        context: SearchContext,
        plan: CompressionPlan,
        rows: list[Row],
        chosen: int | None,
        outcomes: Sequence[Outcome],
    ) -> Decision:
        """The network with the least error among those that fit, and what the second test set says of it."""
        points = [
            (row["error"], row["resource_usage"]["cycles"][2], row["resource_usage"]["parameter_bytes"]) for row in rows
        ]
        budget = context.spec.compression.budget
        facts: dict[str, Any] = {
            "on": True,
            "budget": recipe_of(context).to_json()["budget"],
            "sessions": {"train": list(context.training), "validation": list(context.validation)},
            "second": list(context.second),
            "rows": rows,
            "front": pareto(points),
            "chosen": chosen,
            "notes": list(plan.notes),
            "held_out_test": None,
        }
        sentences = [f"{len(rows)} networks and formats were compared on {', '.join(context.validation)}."]
        if chosen is None:
            return Decision(NAME, facts, (*sentences, f"None of them fits the budget '{budget.name}'."))
        row = rows[chosen]
        usage = row["resource_usage"]
        sentences.append(
            f"Chosen for '{budget.name}': {row['name']} with {usage['parameter_bytes']:,} bytes of parameters "
            f"and {usage['cycles'][2]:,} cycles a tick; its error there is {percent(row['error'] - 1, signed=True)} "
            "against the teacher's."
        )
        formats = ("float32", row["format"])
        format_results = [
            o.result["formats"].get(f) if o.result is not None else None for o, f in zip(outcomes, formats)
        ]
        if None in format_results or not format_results:
            sentences.append("A network could not be judged on the second test set.")
            return Decision(NAME, facts, tuple(sentences))
        scores = {
            who: one["scores"]
            for who, one in zip(("teacher", "chosen"), format_results, strict=True)
            if one is not None
        }
        error = relative(scores["chosen"], scores["teacher"])
        facts["held_out_test"] = {"scores": scores, "error": error}
        sentences.append(
            f"On the second test set ({', '.join(context.second)}), opened for these two alone: "
            f"{percent(error - 1, signed=True)} against the teacher's error."
        )
        return Decision(NAME, facts, tuple(sentences))


def teacher_settings(context: SearchContext) -> Table:
    """Settings of the winner of the search."""
    settings: Table = context.decided["exploration"].facts["teacher_settings"]
    return settings


def recipe_of(context: SearchContext, units: int | None = None, pruned: bool = False) -> Recipe:
    """A recipe under the settings of this search."""
    spec = context.spec.compression
    steps = spec.updates or context.spec.final_updates
    return Recipe(steps, spec.formats or tuple(FORMATS), spec.budget, context.validation, units, pruned)


def order_of(context: SearchContext, settings: Table, recipe: Recipe, judged: Sequence[str] = ()) -> TrainingRequest:
    """The order that makes a network of a recipe and judges it, by default on the sessions that compare."""
    return TrainingRequest(
        settings,
        context.source,
        context.training,
        tuple(judged) or context.validation,
        context.seed(NAME),
        context.spec.final_updates,
        recipe=recipe.to_json(),
        **context.several(context.validation),
    )


def plan_of(context: SearchContext, settings: Table) -> CompressionPlan:
    """Which networks are made.

    Raises:
        ConfigError: a budget that no network of this kind meets.
    """
    spec = context.spec.compression
    experiment = build(Experiment, settings, "of the search")
    task = experiment.task.resolve(100.0, context.channels, experiment.model.physics)
    network = build_model(task, experiment.model, blank_scaler(task), seed=0)
    # Widths beyond the teacher's are left out here: settings are written before its width is known.
    units = [width for width in spec.units if width <= width_of(experiment.model)]
    return make_plan(network, spec.budget, units, spec.formats, shares=spec.shares)


def _better(networks: Sequence[_Made], units: int) -> _Made:
    """Of the networks of a width the one with the least error in float32."""
    return min((one for one in networks if one.recipe.units == units), key=lambda one: one.error)


def rows_of(context: SearchContext, teacher: _Made, networks: Sequence[_Made]) -> list[Row]:
    """Every network in every format that it can be in, in the order in which they were made."""
    rows: list[Row] = []
    base = teacher.outcome.result or {}
    for one in networks:
        result = one.outcome.result
        if result is None:
            continue
        order = one.recipe.order()
        for name, format_result in result["formats"].items():
            rows.append(
                {
                    "name": f"{one.recipe.name} {FORMATS[name].label}",
                    "recipe": "teacher" if order is None else recipe_text(order),
                    "units": one.recipe.units,
                    "pruned": one.recipe.pruned,
                    "rounded": one.recipe.rounded,
                    "format": name,
                    "resource_usage": format_result["resource_usage"],
                    "over": format_result["over"],
                    "scores": format_result["scores"],
                    "before": result["plain"],
                    "error": relative(format_result["scores"], base["plain"]),
                }
            )
    return rows


def chosen_of(rows: Sequence[Row]) -> int | None:
    """Place of the row that fits with the least error, of equals the cheapest; None where none fits."""
    fitting = [index for index, row in enumerate(rows) if not row["over"]]
    # Ties of error go to fewer cycles, then to fewer bytes.
    return min(
        fitting,
        key=lambda i: (
            rows[i]["error"],
            rows[i]["resource_usage"]["cycles"][2],
            rows[i]["resource_usage"]["parameter_bytes"],
        ),
        default=None,
    )


def _final(context: SearchContext, row: Row) -> Recipe:
    return replace(recipe_of(context, row["units"], row["pruned"]), rounded=row["rounded"], final=row["format"])


def _nothing(context: SearchContext, why: str) -> Decision:
    facts = {"on": True, "rows": [], "front": [], "chosen": None, "notes": [why], "held_out_test": None}
    facts |= {"second": list(context.second), "budget": recipe_of(context).to_json()["budget"]}
    return Decision(NAME, facts, (why, "The second test set stays closed."))


PHASES.register(NAME)(CompressionPhase())
