"""What phases 4 and 5 share: modules and rates tuned together, and what came of it."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edp.config.experiment import Table
from edp.errors import DataError, count_of
from edp.stats.pareto import pareto
from edp.workflows.search.context import Outcome, SearchContext
from edp.workflows.search.modules import contradicting, present_options
from edp.workflows.search.phases.base import (
    AnsweredQuestion,
    Quest,
    answer_all,
    best,
    mean_of,
    new_study,
    said_of_pruned,
)
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.space import Candidate, Choice, Real, Space, apply
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import TrainingRequest

Asked = Generator[list[TrainingRequest], list[Outcome], list[AnsweredQuestion]]


@dataclass(frozen=True)
class JointStart:
    """A warm start: values, and the modules that are on."""

    values: Candidate
    modules: Sequence[str]


def ask_together(
    context: SearchContext,
    name: str,
    modules: Sequence[str],
    trials: int,
    starts: Sequence[JointStart],
    options: Mapping[str, Mapping[str, Choice]] | None = None,
) -> Asked:
    """Questions about modules on or off, rates inside the window and what was deferred, with warm starts first.

    Args:
        context: with the baseline of phase 1.
        name: of the phase.
        modules: and toggles that may be on.
        trials: how many questions, the warm starts among them.
        starts: what to begin with.
        options: what is varied of a module where it is on.
    """
    base, _, window = baseline_of(context)
    # Pairs that contradict each other are barred, so that no question is wasted on them.
    space = {**window, **context.spec.deferred}
    study = new_study(context, name, space, modules, contradicting(base, modules, context.channels))
    study.options = options or {}
    for start in starts[:trials]:
        # Options of phase 4 stand at their present values, which phase 5 may change.
        present = present_options(base, start.modules, context.shaped) if options else None
        study.suggest(_inside(space, start.values), start.modules, present)

    def settings(trial: Trial) -> Table:
        return context.network(apply(base, trial.values), trial.flags, trial.options)

    # The thesis prunes in phase 1 only (3.3.2).
    stops = () if context.spec.mode == "thesis" else context.spec.stops
    (answers,) = yield from answer_all(context, [Quest(study, settings, trials)], stops)
    return answers


def winner_of(
    context: SearchContext, name: str, modules: Sequence[str], answers: list[AnsweredQuestion]
) -> dict[str, Any]:
    """The best answer, how often each module was on, and the front where a cost counts.

    Raises:
        DataError: no training ended well.
    """
    winner = best(answers)
    if winner is None:
        raise DataError(
            f"{name}: none of {count_of(len(answers), 'training')} ended well; see their messages in the ledger"
        )
    done = [answer for answer in answers if answer.score is not None]
    facts: dict[str, Any] = {
        "settings": winner.settings,
        "values": {**winner.trial.values, **winner.trial.options},
        "modules": list(winner.trial.flags),
        "score": winner.score,
        "costs": winner.costs,
        "on": {module: sum(module in answer.trial.flags for answer in done) / len(done) for module in modules},
        "trials": [
            {
                "number": answer.trial.number,
                "values": {**answer.trial.values, **answer.trial.options},
                "modules": list(answer.trial.flags),
                "score": answer.score,
                "mae": None if answer.pruned else mean_of(context, answer.outcomes, "mae"),
                **answer.costs,
                **answer.course(),
            }
            for answer in answers
        ],
    }
    facts["said_of_pruned"] = said_of_pruned(context, answers)
    if context.spec.cost != "none":
        points = [(answer.score or 0.0, answer.costs[context.spec.cost]) for answer in done]
        facts["front"] = [done[index].trial.number for index in pareto(points)]
    return facts


def _inside(window: Space, values: Candidate) -> dict[str, Any]:
    """Values of the window's dimensions, brought into it."""
    # Values from outside of the window would be refused as a warm start.
    clipped: dict[str, Any] = {}
    for name, dimension in window.items():
        if name in values:
            clipped[name] = (
                min(max(float(values[name]), dimension.low), dimension.high)
                if isinstance(dimension, Real)
                else values[name]
            )
    return clipped
