"""Common part of phases 4 and 5: modules and rates tuned together, and the result."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

from edp.errors import DataError, count_of
from edp.evaluation.study_facts import JointFacts
from edp.stats.pareto import pareto
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.modules import contradicting, present_options
from edp.workflows.search.phases.base import Quest, answer_all, best, new_study, said_of_pruned, scored
from edp.workflows.search.phases.screening import baseline_of
from edp.workflows.search.space import Candidate, Choice, Real, Space, Value, apply
from edp.workflows.search.study import Trial
from edp.workflows.search.trainings import Outcome, TrainingRequest

Asked = Generator[list[TrainingRequest], list[Outcome], list[Trial]]


def ask_together(
    context: SearchContext,
    name: str,
    modules: Sequence[str],
    trials: int,
    starts: Sequence[Trial],
    options: Mapping[str, Mapping[str, Choice]] | None = None,
) -> Asked:
    """Ask about active modules, rates inside the window and deferred options, with warm starts first.

    Args:
        context: context with the baseline of phase 1.
        name: name of the phase.
        modules: and toggles that may be on.
        trials: number of trials, including the warm starts.
        starts: warm starts.
        options: options of each module that vary while it is active.
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

    def arm(trial: Trial) -> Arm:
        return context.network(apply(base, trial.values), trial.modules, trial.options)

    # The thesis prunes in phase 1 only (3.3.2).
    stops = () if context.spec.mode == "thesis" else context.spec.stops
    (answers,) = yield from answer_all(context, [Quest(study, arm, trials)], stops)
    return answers


def winner_of(context: SearchContext, name: str, modules: Sequence[str], trials: list[Trial]) -> JointFacts:
    """Return the best trial, the frequency of each module, and the front if a cost counts.

    Raises:
        DataError: no training ended well.
    """
    winner = best(trials)
    if winner is None or winner.score is None:
        raise DataError(
            f"{name}: none of {count_of(len(trials), 'training')} ended well; see their messages in the ledger"
        )
    done = scored(trials)
    front = None
    if context.spec.cost != "none":
        indices = pareto([(score, trial.costs[context.spec.cost]) for score, trial in done])
        front = tuple(done[index][1].number for index in indices)
    return JointFacts(
        settings=winner.arm.tables,
        values={**winner.values, **winner.options},
        modules=winner.modules,
        score=winner.score,
        costs=winner.costs,
        on={module: sum(module in trial.modules for _, trial in done) / len(done) for module in modules},
        trials=tuple(replace(trial.row(context.spec.horizon), modules=trial.modules) for trial in trials),
        said_of_pruned=tuple(said_of_pruned(context, trials)),
        front=front,
    )


def _inside(window: Space, values: Candidate) -> dict[str, Value]:
    """Return the values of the window's dimensions, brought into it."""
    # Values from outside of the window would be refused as a warm start.
    clipped: dict[str, Value] = {}
    for name, dimension in window.items():
        if name in values:
            clipped[name] = (
                min(max(float(values[name]), dimension.low), dimension.high)
                if isinstance(dimension, Real)
                else values[name]
            )
    return clipped
