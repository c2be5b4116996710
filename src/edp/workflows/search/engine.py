"""Engine of a search: runs the phases, and orders the trainings that they request.

`TrainingRequest` is what a phase asks for; `edp.workflows.search.jobs.job_of` makes a `Job` of it, whose key covers all
that decides the result; whoever does the job answers with a `Record`, which the ledger keeps under that key; an
`Outcome` is the record with its request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from edp.errors import ConfigError, DataError, LostError, count_of
from edp.evaluation.study import Decision
from edp.jobs.base import START, Executor, Job, complete
from edp.storage.ledger import FINAL, Ledger, Record, TrainingStatus
from edp.workflows.search.context import SearchContext
from edp.workflows.search.jobs import job_of
from edp.workflows.search.phases import PHASES
from edp.workflows.search.smaller import before
from edp.workflows.search.trainings import Outcome, TrainingRequest

Do = Callable[[list[TrainingRequest]], list[Outcome]]
"""Has orders done side by side; outcomes in their order. Orders that were done before need not be done again. That of
a study is a `Dispatcher`."""


def run_phases(
    context: SearchContext,
    do: Do,
    until: str | None = None,
    on_decision: Callable[[Decision], None] | None = None,
    phases: Sequence[str] | None = None,
    on_phase: Callable[[str, SearchContext], None] | None = None,
) -> SearchContext:
    """Run the phases in order; each builds on earlier decisions.

    Nothing is remembered between calls but what `do` remembers: phases are pure, so a search that was stopped comes
    to the same decisions again, with the same orders.

    Args:
        context: data of all phases.
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
    """Return the outcomes of a batch, or raise if they show a fault that forbids a decision.

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


@dataclass(frozen=True)
class Dispatcher:
    """Executor of the trainings that a phase requests.

    Attributes:
        ledger: ledger of the study.
        executor: does what the ledger does not hold.
        data: hash of the recordings.
        threads: number of threads of each training; the pool pins as many.
        seconds: cap on the time of a training.
        memory_mb: cap on its memory.
        on_batch: called with the requests of a batch by key before any of them is done.
        on_record: called with each record, its request, and whether it was trained now.
        teacher_keys: keys of the networks of phase 6, whose states later ones are made of.
    """

    ledger: Ledger
    executor: Executor
    data: str
    threads: int = 1
    seconds: float | None = None
    memory_mb: float | None = None
    on_batch: Callable[[Mapping[str, TrainingRequest]], None] = lambda batch: None
    on_record: Callable[[Record, TrainingRequest, bool], None] = lambda record, request, trained: None
    teacher_keys: set[str] = field(default_factory=set)

    def __call__(self, requests: list[TrainingRequest]) -> list[Outcome]:
        """Return the outcomes in the order of the requests; equal ones are done once.

        Parts of trainings go on from the latest part before them whose state is still there. Once a batch is trained,
        states of other batches are not needed any more and removed.
        """
        keys = [self._job(request).key for request in requests]
        batch = dict(zip(keys, requests, strict=True))
        self.on_batch(batch)
        # Asked before the trainings: afterwards every record is there.
        new = any(self.ledger.finished(key) is None for key in batch)
        records = complete(
            self.ledger,
            self.executor,
            [self._make_job(request) for request in batch.values()],
            lambda record, trained: self.on_record(record, batch[record.key], trained),
        )
        self.teacher_keys.update(key for key, request in batch.items() if request.recipe is not None)
        # A search that goes on comes by earlier batches first, and one that stops here needs what it had.
        if new and all(record.status in FINAL for record in records.values()):
            self.ledger.keep_states({*self.teacher_keys, *batch})
        return [Outcome.from_record(request, records[key]) for request, key in zip(requests, keys, strict=True)]

    def _job(self, request: TrainingRequest) -> Job:
        return job_of(request, self.data, self.threads, self.seconds, self.memory_mb)

    def _make_job(self, request: TrainingRequest) -> Job:
        """Return the job of a request with its start state, if it has one."""
        job = self._job(request)
        if self.ledger.finished(job.key):
            return job
        # The latest rung saves most of the training.
        rungs = [replace(request, until=stop, stops=()) for stop in reversed(request.stops)]
        for earlier in [*rungs, *before(request)]:
            file = self.ledger.state(self._job(earlier).key)
            if file is not None:
                return replace(job, where={**job.where, START: str(file)})
        return job
