"""What a phase is, and what several of them do: ask a study, train its questions, tell it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from edp.config.experiment import Table
from edp.errors import ConfigError
from edp.registry import Registry
from edp.stats.clustered import MeanTest
from edp.wording import percent
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.space import Choice, Range, Space, apply
from edp.workflows.search.study import Study, Trial
from edp.workflows.search.trainings import TrainingRequest, costs_of

Course = Generator[list[TrainingRequest], list[Outcome], Decision]
"""Yields orders that may be done side by side, is sent their outcomes in the same order, and returns a decision."""


class PhaseSpec(Protocol):
    """A phase: a pure function of the context and of the results of its orders; it does nothing else.

    Attributes:
        title: for progress and reports.
    """

    title: str

    def run(self, context: SearchContext) -> Course:
        """The trainings that it needs, batch by batch, and what follows from them."""
        ...

    def trainings(self, context: SearchContext) -> int:
        """How many it will order at most, as far as is known now; for the time left, and for nothing else."""
        ...


PHASES: Registry[PhaseSpec] = Registry("phase")
"""In the order in which they run."""


@dataclass(frozen=True)
class AnsweredQuestion:
    """A question of a study and what came of it.

    Attributes:
        trial: the question.
        settings: the experiment that it stands for.
        costs: analytic costs of its network, by name; none where its values make no network.
        score: mean over its runs; None where it was not trained for its costs, was pruned, or failed.
        outcomes: of its runs, of their last parts; none where it was not trained.
        rungs: means over its runs at steps before the end.
        pruned: whether it was ended at the last of these.
    """

    trial: Trial
    settings: Table
    costs: dict[str, float]
    score: float | None
    outcomes: tuple[Outcome, ...]
    rungs: Mapping[int, float] = field(default_factory=dict)
    pruned: bool = False

    def course(self) -> dict[str, Any]:
        """Its rungs as plain values; nothing where it had none."""
        if not self.rungs:
            return {}
        return {"rungs": [[step, value] for step, value in self.rungs.items()], "pruned": self.pruned}


@dataclass(frozen=True)
class Quest:
    """A study with what its questions mean.

    Attributes:
        study: which asks.
        settings: the experiment that a question stands for.
        trials: how many questions.
    """

    study: Study
    settings: Callable[[Trial], Table]
    trials: int


@dataclass
class _Asked:
    """A question of a batch while it is trained.

    Attributes:
        quest_number: of its quest.
        trial, settings, costs: see `AnsweredQuestion`.
        orders: whole trainings, one a run; none where it is not trained.
        outcomes: of the last part of each.
        rungs: means over runs, by the step of the rung.
        pruned: whether it ended at the last of these.
    """

    quest_number: int
    trial: Trial
    settings: Table
    costs: dict[str, float]
    orders: list[TrainingRequest]
    outcomes: tuple[Outcome, ...] = ()
    rungs: dict[int, float] = field(default_factory=dict)
    pruned: bool = False


def answer_all(
    context: SearchContext, quests: list[Quest], stops: Sequence[int] = ()
) -> Generator[list[TrainingRequest], list[Outcome], list[list[AnsweredQuestion]]]:
    """Ask all quests side by side, a batch each at a time, until each has all its answers.

    A question whose costs exceed the limits, or whose network cannot be, is reported so and not trained.

    Args:
        context: of the search.
        quests: that are asked.
        stops: steps at which trainings of a batch are judged and may end early. All of a batch are judged by what was
            reported of earlier batches, in the order of their numbers, so that who trained them has no say.
    """
    spec = context.spec
    answers: list[list[AnsweredQuestion]] = [[] for _ in quests]
    while any(len(have) < quest.trials for have, quest in zip(answers, quests, strict=True)):
        batch = [
            _asked(context, quest_number, trial, quest.settings(trial))
            for quest_number, quest in enumerate(quests)
            # Never more than are left: a study must not ask what nobody answers.
            for trial in quest.study.ask(min(spec.batch, quest.trials - len(answers[quest_number])))
        ]
        alive = batch
        for number, stop in enumerate([*stops, None]):
            earlier = tuple(stops[:number])
            # Rungs of a training are separate jobs with keys of their own (decision 26).
            some = [[replace(order, until=stop, stops=earlier) for order in one.orders] for one in alive]
            outcomes = iter((yield [order for orders in some for order in orders]))
            for one, orders in zip(alive, some, strict=True):
                one.outcomes = tuple(next(outcomes) for _ in orders)
            if stop is None:
                break
            alive = [one for one in alive if _goes_on(context, quests[one.quest_number].study, one, stop)]
            if not alive:
                break
        for one in batch:
            score = None if one.pruned else mean_of(context, one.outcomes)
            answer = AnsweredQuestion(one.trial, one.settings, one.costs, score, one.outcomes, one.rungs, one.pruned)
            answers[one.quest_number].append(answer)
            tell(context, quests[one.quest_number].study, answer)
    return answers


def _asked(context: SearchContext, quest_number: int, trial: Trial, settings: Table) -> _Asked:
    spec = context.spec
    costs = _costs(settings, context)
    # Limits on cost are checked before training: what does not fit is never trained.
    fits = bool(costs) and all(costs[name] <= most for name, most in spec.limits.items())
    return _Asked(
        quest_number, trial, settings, costs, context.orders(settings, range(spec.trial_runs)) if fits else []
    )


def _goes_on(context: SearchContext, study: Study, one: _Asked, stop: int) -> bool:
    """Whether a question is trained beyond a rung: it ended well there, and is not hopeless."""
    score = mean_of(context, one.outcomes)
    if score is None:
        return False
    one.rungs[stop] = score
    if context.spec.pruner != "none":
        study.report(one.trial.number, stop, score)
        one.pruned = study.hopeless(one.trial.number)
    return not one.pruned


def _costs(settings: Table, context: SearchContext) -> dict[str, float]:
    # The study decides by batches before this one, so that the order of ends does not matter.
    try:
        return costs_of(settings, context.channels)
    # A combination of legal values without a network is an answer too: the study learns to avoid it.
    except ConfigError:  # values that are each in their range, and make no network together
        return {}


def possible(context: SearchContext, space: Space, arm: Table) -> tuple[Space, list[str]]:
    """The part of a space in which every value makes a network of this arm, and in words what was left out."""
    feasible: dict[str, Range] = {}
    notes = []
    for name, dimension in space.items():
        if not isinstance(dimension, Choice):
            feasible[name] = dimension
            continue
        fit = tuple(value for value in dimension.options if _costs(context.shaped(apply(arm, {name: value})), context))
        out = [str(value) for value in dimension.options if value not in fit]
        if len(fit) > 1:
            feasible[name] = Choice(fit)
        if out:
            left = f"{', '.join(map(str, fit))} stay" if len(fit) > 1 else "it keeps its own"
            notes.append(f"{name} {', '.join(out)} cannot be with a window of {arm['model']['window']}; {left}")
    return feasible, notes


def tell(context: SearchContext, study: Study, answer: AnsweredQuestion) -> None:
    """Pass an answer on to its study."""
    spec = context.spec
    # Positive means violated, as Optuna has it.
    bounds = [answer.costs[name] / most - 1.0 if answer.costs else 1.0 for name, most in sorted(spec.limits.items())]
    values = None
    if answer.score is not None:
        # Failed trainings have no value: a worst one would bend the sampler's model.
        values = [answer.score] if spec.cost == "none" else [answer.score, answer.costs[spec.cost]]
    study.tell(answer.trial.number, values, bounds, answer.pruned)


def new_study(
    context: SearchContext,
    name: str,
    space: Space,
    flags: Sequence[str] = (),
    barred: frozenset[frozenset[str]] = frozenset(),
) -> Study:
    """A study under the costs and limits of this search, with a root of its own."""
    spec = context.spec
    objectives = 1 if spec.cost == "none" else 2
    root = context.seed("study", name)
    return Study(space, root, spec.sampler, tuple(flags), barred, objectives, len(spec.limits), spec.pruner)


def said_of_pruned(context: SearchContext, answers: Sequence[AnsweredQuestion]) -> list[str]:
    """A sentence on the questions that were ended at a rung; none where none was."""
    pruned = [answer for answer in answers if answer.pruned]
    if not pruned:
        return []
    saved = sum(1.0 - max(answer.rungs) / context.spec.length for answer in pruned)
    # Questions refused for their costs spent no steps and do not count.
    share = saved / max(1, sum(bool(answer.outcomes) for answer in answers))
    return [
        f"{len(pruned)} of {len(answers)} questions were ended at a rung as worse than the median there, which spared "
        f"{percent(share)} of the steps."
    ]


def best(answers: list[AnsweredQuestion]) -> AnsweredQuestion | None:
    """The answer with the lowest score; None where none was trained to its end."""
    done = [answer for answer in answers if answer.score is not None]
    # Ties go to the earlier question, so that replays decide alike.
    return min(done, key=lambda answer: (answer.score, answer.trial.number), default=None)


def mean_of(context: SearchContext, outcomes: Sequence[Outcome], name: str = "composite") -> float | None:
    """A score, mean over outcomes; None where there is none, or one did not end well."""
    values = [outcome.mean(context.spec.horizon, name) for outcome in outcomes]
    return float(np.mean(values)) if values and np.isfinite(values).all() else None


def changed(test: MeanTest, reference: float) -> dict[str, float]:
    """A test of a mean difference as shares of a reference: change, its 95 % interval and the one-sided p-value."""
    low, high = test.interval()
    return {
        "change": float(test.mean) / reference,
        "low": float(low) / reference,
        "high": float(high) / reference,
        "p": float(test.p),
    }
