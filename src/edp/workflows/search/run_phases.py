"""Walk through the phases: ask for orders, have them done, hand on what came of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from edp.errors import ConfigError, DataError, LostError, count_of
from edp.storage.ledger import TrainingStatus
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.phases import PHASES
from edp.workflows.search.trainings import TrainingRequest

Do = Callable[[list[TrainingRequest]], list[Outcome]]
"""Has orders done side by side; outcomes in their order. Orders that were done before need not be done again. That of
a study is an `edp.workflows.search.dispatch.Dispatcher`."""


def run_phases(
    context: SearchContext,
    do: Do,
    until: str | None = None,
    on_decision: Callable[[Decision], None] | None = None,
    phases: Sequence[str] | None = None,
    on_phase: Callable[[str, SearchContext], None] | None = None,
) -> SearchContext:
    """Run the phases in order, each on what the ones before decided.

    Nothing is remembered between calls but what `do` remembers: phases are pure, so a search that was stopped comes
    to the same decisions again, with the same orders.

    Args:
        context: what the phases stand on.
        do: has orders done.
        until: the last phase to run; None for all.
        on_decision: called with each decision.
        phases: names of those to run; None for all that are registered.
        on_phase: called with each phase before it begins, and with what it rests on.

    Raises:
        ConfigError: an unknown phase.
        LostError: a training was lost.
        DataError: every one of several trainings of a batch ended in an error.
    """
    names = list(PHASES if phases is None else phases)
    if until is not None:
        _ = PHASES[until]
        if until not in names:
            raise ConfigError(f"search: phase '{until}' is not among those to run: {', '.join(names)}")
        names = names[: names.index(until) + 1]
    for name in names:
        if on_phase is not None:
            on_phase(name, context)
        decision = _run(name, context, do)
        # A new context each time: phases cannot change what others have decided.
        context = replace(context, decided={**context.decided, name: decision})
        if on_decision is not None:
            on_decision(decision)
    return context


def _run(name: str, context: SearchContext, do: Do) -> Decision:
    course = PHASES[name].run(context)
    try:
        # A phase is a coroutine: it keeps its place between batches and holds no other state.
        orders = next(course)
        while True:
            orders = course.send(_sound(do(orders)))
    except StopIteration as end:
        decision: Decision = end.value
        return decision


def _sound(outcomes: list[Outcome]) -> list[Outcome]:
    """The outcomes of a batch, unless they tell of a fault that a decision must not rest on.

    Raises:
        LostError: a training was lost.
        DataError: every one of several trainings ended in an error.
    """
    lost = [outcome for outcome in outcomes if outcome.status == TrainingStatus.LOST]
    if lost:
        raise LostError(
            f"{count_of(len(lost), 'training')} lost: {lost[0].message}. What is done is kept; free memory or take "
            "fewer "
            "workers, and give the same command again"
        )
    # One failure is a result; a whole batch of them is a fault that a decision must not rest on.
    failed = [outcome for outcome in outcomes if outcome.status == TrainingStatus.FAILED]
    if len(outcomes) > 1 and len(failed) == len(outcomes):
        raise DataError(
            f"all {count_of(len(outcomes), 'training')} of a batch failed; the first says: {failed[0].message}"
        )
    return outcomes
