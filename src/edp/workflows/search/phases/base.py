"""Interface of a phase, and common steps: request trainings of a study, train them, report results."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from edp.errors import ConfigError
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import RelativeChange
from edp.registry import Registry
from edp.stats.clustered import MeanTest
from edp.wording import percent
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.space import Choice, Range, Space, apply
from edp.workflows.search.study import Study, Trial
from edp.workflows.search.trainings import Outcome, TrainingRequest, costs_of

Course = Generator[list[TrainingRequest], list[Outcome], Decision]
"""Yields orders that may be done side by side, is sent their outcomes in the same order, and returns a decision."""


class PhaseSpec(Protocol):
    """Phase: a pure function of the context and of the outcomes of its requests, without side effects.

    Attributes:
        title: title for progress and reports.
    """

    title: str

    def run(self, context: SearchContext) -> Course:
        """Yield the required trainings batch by batch, and return the conclusions."""
        ...

    def trainings(self, context: SearchContext) -> int:
        """Return the largest number of requests known now, for the estimate of the remaining time."""
        ...


PHASES: Registry[PhaseSpec] = Registry("phase")
"""In the order in which they run."""


@dataclass(frozen=True)
class Quest:
    """A study with what its trials mean.

    Attributes:
        study: study of the trials.
        arm: function that gives the arm of a trial.
        trials: number of trials.
    """

    study: Study
    arm: Callable[[Trial], Arm]
    trials: int


def answer_all(
    context: SearchContext, quests: list[Quest], stops: Sequence[int] = ()
) -> Generator[list[TrainingRequest], list[Outcome], list[list[Trial]]]:
    """Run all studies in parallel, one batch of trainings each at a time, until every study is complete.

    A trial whose costs exceed the limits, or whose network cannot be, is reported so and not trained.

    Args:
        context: context of the search.
        quests: quests to answer.
        stops: steps at which trainings of a batch are evaluated and may end early. All of a batch are evaluated by what
            was reported of earlier batches, in the order of their numbers, so that who trained them has no say.
    """
    spec = context.spec
    answers: list[list[Trial]] = [[] for _ in quests]
    while any(len(have) < quest.trials for have, quest in zip(answers, quests, strict=True)):
        batch = [
            (quest, own, _prepare(context, quest, trial))
            for quest, own in zip(quests, answers, strict=True)
            # Never more than are left: a study must not ask what nobody answers.
            for trial in quest.study.ask(min(spec.batch, quest.trials - len(own)))
        ]
        alive = [(quest.study, trial) for quest, _, trial in batch]
        for number, stop in enumerate([*stops, None]):
            earlier = tuple(stops[:number])
            # Rungs of a training are separate jobs with keys of their own (decision 26).
            outcomes = iter(
                (yield [replace(one, until=stop, stops=earlier) for _, trial in alive for one in trial.requests])
            )
            for _, trial in alive:
                trial.outcomes = [next(outcomes) for _ in trial.requests]
            if stop is None:
                break
            alive = [(study, trial) for study, trial in alive if _goes_on(context, study, trial, stop)]
            if not alive:
                break
        for quest, own, trial in batch:
            trial.score = None if trial.pruned else trial.mean(spec.horizon)
            own.append(trial)
            _report_trial(context, quest.study, trial)
    return answers


def _prepare(context: SearchContext, quest: Quest, trial: Trial) -> Trial:
    trial.arm = quest.arm(trial)
    trial.costs = _costs(trial.arm, context)
    # Limits on cost are checked before training: what does not fit is never trained.
    if trial.costs and all(trial.costs[name] <= most for name, most in context.spec.limits.items()):
        trial.requests = context.orders(trial.arm, range(context.spec.trial_runs))
    return trial


def _goes_on(context: SearchContext, study: Study, trial: Trial, stop: int) -> bool:
    """Return whether a trial is trained beyond a rung: it ended well there, and is not hopeless."""
    score = trial.mean(context.spec.horizon)
    if score is None:
        return False
    trial.rungs[stop] = score
    if context.spec.pruner != "none":
        study.report(trial.number, stop, score)
        trial.pruned = study.hopeless(trial.number)
    return not trial.pruned


def _costs(arm: Arm, context: SearchContext) -> dict[str, float]:
    # A combination of legal values without a network is an answer too: the study learns to avoid it.
    try:
        return costs_of(arm, context.channels)
    except ConfigError:  # values that are each in their range, and make no network together
        return {}


def possible(context: SearchContext, space: Space, arm: Arm) -> tuple[Space, list[str]]:
    """Return the part of a space in which every value gives a network of this arm, and notes on the excluded part."""
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
            notes.append(f"{name} {', '.join(out)} cannot be with a window of {arm['model.window']}; {left}")
    return feasible, notes


def _report_trial(context: SearchContext, study: Study, trial: Trial) -> None:
    """Pass the score of a trial on to its study."""
    spec = context.spec
    # Positive means violated, as Optuna has it.
    bounds = [trial.costs[name] / most - 1.0 if trial.costs else 1.0 for name, most in sorted(spec.limits.items())]
    values = None
    if trial.score is not None:
        # Failed trainings have no value: a worst one would bend the sampler's model.
        values = [trial.score] if spec.cost == "none" else [trial.score, trial.costs[spec.cost]]
    study.tell(trial.number, values, bounds, trial.pruned)


def new_study(
    context: SearchContext,
    name: str,
    space: Space,
    flags: Sequence[str] = (),
    barred: frozenset[frozenset[str]] = frozenset(),
) -> Study:
    """Return a study under the costs and limits of this search, with its own root."""
    spec = context.spec
    objectives = 1 if spec.cost == "none" else 2
    root = context.seed("study", name)
    return Study(space, root, spec.sampler, tuple(flags), barred, objectives, len(spec.limits), spec.pruner)


def said_of_pruned(context: SearchContext, trials: Sequence[Trial]) -> list[str]:
    """Return a sentence on the trials that ended early; empty without such trials."""
    pruned = [trial for trial in trials if trial.pruned]
    if not pruned:
        return []
    saved = sum(1.0 - max(trial.rungs) / context.spec.length for trial in pruned)
    # Questions refused for their costs spent no steps and do not count.
    share = saved / max(1, sum(bool(trial.outcomes) for trial in trials))
    return [
        f"{len(pruned)} of {len(trials)} questions were ended at a rung as worse than the median there, which spared "
        f"{percent(share)} of the steps."
    ]


def scored(trials: Sequence[Trial]) -> list[tuple[float, Trial]]:
    """Return the trials that were trained to their end, with their scores."""
    return [(trial.score, trial) for trial in trials if trial.score is not None]


def best(trials: Sequence[Trial]) -> Trial | None:
    """Return the trial with the lowest score; None without a complete trial."""
    # Ties go to the earlier question, so that replays decide alike.
    pairs = scored(trials)
    return min(pairs, key=lambda pair: (pair[0], pair[1].number))[1] if pairs else None


def relative_change(test: MeanTest, reference: float) -> RelativeChange:
    """Return a test of a mean difference as fractions of a reference."""
    low, high = test.interval()
    return RelativeChange(float(test.mean) / reference, float(low) / reference, float(high) / reference, float(test.p))
