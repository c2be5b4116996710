"""What a phase is, and what several of them do: ask a study, train its questions, tell it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edp.config import Table
from edp.errors import ConfigError
from edp.registry import Registry
from edp.search.ground import Decision, Ground, Outcome
from edp.search.space import Choice, Range, Space, apply
from edp.search.study import Study, Trial
from edp.search.trainings import Order, costs_of
from edp.stats.clustered import MeanTest

Course = Generator[list[Order], list[Outcome], Decision]
"""Yields orders that may be done side by side, is sent their outcomes in the same order, and returns a decision."""


class PhaseSpec(Protocol):
    """A phase: a pure function of the ground and of what came of its orders; it does nothing else.

    Attributes:
        title: for progress and reports.
    """

    title: str

    def run(self, ground: Ground) -> Course:
        """The trainings that it needs, batch by batch, and what follows from them."""
        ...

    def trainings(self, ground: Ground) -> int:
        """How many it will order at most, as far as is known now; for the time left, and for nothing else."""
        ...


PHASES: Registry[PhaseSpec] = Registry("phase")
"""In the order in which they run."""


@dataclass(frozen=True)
class Answer:
    """A question of a study and what came of it.

    Attributes:
        trial: the question.
        settings: the experiment that it stands for.
        costs: analytic costs of its network, by name; none where its values make no network.
        score: mean over its runs; None where it was not trained for its costs, or failed.
        outcomes: of its runs; none where it was not trained.
    """

    trial: Trial
    settings: Table
    costs: dict[str, float]
    score: float | None
    outcomes: tuple[Outcome, ...]


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


def answer_all(ground: Ground, quests: list[Quest]) -> Generator[list[Order], list[Outcome], list[list[Answer]]]:
    """Ask all quests side by side, a batch each at a time, until each has all its answers.

    A question whose costs exceed the limits, or whose network cannot be, is told so and not trained.
    """
    spec = ground.spec
    answers: list[list[Answer]] = [[] for _ in quests]
    while any(len(have) < quest.trials for have, quest in zip(answers, quests, strict=True)):
        asked = [
            (place, trial, quest.settings(trial))
            for place, quest in enumerate(quests)
            for trial in quest.study.ask(min(spec.batch, quest.trials - len(answers[place])))
        ]
        costs = [_costs(settings, ground) for _, _, settings in asked]
        fit = [bool(cost) and all(cost[name] <= most for name, most in spec.limits.items()) for cost in costs]
        orders = [
            ground.orders(settings, range(spec.trial_runs)) if fits else []
            for (_, _, settings), fits in zip(asked, fit, strict=True)
        ]
        outcomes = iter((yield [order for some in orders for order in some]))
        for (place, trial, settings), cost, some in zip(asked, costs, orders, strict=True):
            own = tuple(next(outcomes) for _ in some)
            answer = Answer(trial, settings, cost, mean_of(ground, own), own)
            answers[place].append(answer)
            tell(ground, quests[place].study, answer)
    return answers


def _costs(settings: Table, ground: Ground) -> dict[str, float]:
    try:
        return costs_of(settings, ground.channels)
    except ConfigError:  # values that are each in their range, and make no network together
        return {}


def possible(ground: Ground, space: Space, arm: Table) -> tuple[Space, list[str]]:
    """The part of a space in which every value makes a network of this arm, and in words what was left out."""
    kept: dict[str, Range] = {}
    notes = []
    for name, held in space.items():
        if not isinstance(held, Choice):
            kept[name] = held
            continue
        fit = tuple(value for value in held.options if _costs(apply(arm, {name: value}), ground))
        out = [str(value) for value in held.options if value not in fit]
        if len(fit) > 1:
            kept[name] = Choice(fit)
        if out:
            left = f"{', '.join(map(str, fit))} stay" if len(fit) > 1 else "it keeps its own"
            notes.append(f"{name} {', '.join(out)} cannot be with a window of {arm['model']['window']}; {left}")
    return kept, notes


def tell(ground: Ground, study: Study, answer: Answer) -> None:
    """Pass an answer on to its study."""
    spec = ground.spec
    bounds = [answer.costs[name] / most - 1.0 if answer.costs else 1.0 for name, most in sorted(spec.limits.items())]
    values = None
    if answer.score is not None:
        values = [answer.score] if spec.cost == "none" else [answer.score, answer.costs[spec.cost]]
    study.tell(answer.trial.number, values, bounds)


def new_study(
    ground: Ground,
    name: str,
    space: Space,
    flags: Sequence[str] = (),
    barred: frozenset[frozenset[str]] = frozenset(),
) -> Study:
    """A study under the costs and limits of this search, with a root of its own."""
    spec = ground.spec
    objectives = 1 if spec.cost == "none" else 2
    root = ground.seed("study", name)
    return Study(space, root, spec.sampler, tuple(flags), barred, objectives, len(spec.limits))


def best(answers: list[Answer]) -> Answer | None:
    """The answer with the lowest score; None where none was trained to its end."""
    done = [answer for answer in answers if answer.score is not None]
    return min(done, key=lambda answer: (answer.score, answer.trial.number), default=None)


def mean_of(ground: Ground, outcomes: Sequence[Outcome], name: str = "composite") -> float | None:
    """A score, mean over outcomes; None where there is none, or one did not end well."""
    values = [outcome.mean(ground.spec.horizon, name) for outcome in outcomes]
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
