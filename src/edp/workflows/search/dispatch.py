"""The way of a training: a phase asks for it, a process does it, the ledger keeps it, the phase hears of it.

`TrainingRequest` is what a phase asks for; `edp.workflows.search.jobs.job_of` makes a `Job` of it, whose key covers all
that decides the result; whoever does the job answers with a `Record`, which the ledger keeps under that key; an
`Outcome` is the record beside its request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from edp.jobs.base import START, Executor, Job, complete
from edp.storage.ledger import FINAL, Ledger, Record
from edp.workflows.search.context import Outcome
from edp.workflows.search.jobs import job_of
from edp.workflows.search.smaller import before
from edp.workflows.search.trainings import TrainingRequest


@dataclass(frozen=True)
class Dispatcher:
    """Has the trainings done that a phase asks for: what `edp.workflows.search.run_phases` calls.

    Attributes:
        ledger: of the study.
        executor: does what the ledger does not hold.
        data: hash of the recordings.
        threads: of each training; the pool pins as many.
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
        """Outcomes in the order of the requests; equal ones are done once.

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
            [self._begun(request) for request in batch.values()],
            lambda record, trained: self.on_record(record, batch[record.key], trained),
        )
        self.teacher_keys.update(key for key, request in batch.items() if request.recipe is not None)
        # A search that goes on comes by earlier batches first, and one that stops here needs what it had.
        if new and all(record.status in FINAL for record in records.values()):
            self.ledger.keep_states({*self.teacher_keys, *batch})
        return [Outcome.of(request, records[key]) for request, key in zip(requests, keys, strict=True)]

    def _job(self, request: TrainingRequest) -> Job:
        return job_of(request, self.data, self.threads, self.seconds, self.memory_mb)

    def _begun(self, request: TrainingRequest) -> Job:
        """The job of a request, with the state from which it goes on, where there is one."""
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
