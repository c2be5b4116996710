"""What the phases of a search call to have their orders done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from edp.storage.ledger import FINAL, Ledger, Record
from edp.workflows.search.batch import complete
from edp.workflows.search.context import Outcome
from edp.workflows.search.executor import START, Executor, Job
from edp.workflows.search.jobs import job_of
from edp.workflows.search.smaller import before
from edp.workflows.search.trainings import TrainingRequest


@dataclass(frozen=True)
class Dispatcher:
    """Has the orders of a phase done: what `edp.workflows.search.run_phases` calls.

    Attributes:
        ledger: of the study.
        executor: does what the ledger does not hold.
        data: hash of the recordings.
        threads: of each training; the pool pins as many.
        seconds: cap on the time of a training.
        memory_mb: cap on its memory.
        on_record: called with each record, and whether it was trained now.
        on_orders: called with each batch before it is done: keys and orders.
        teacher_keys: keys of the networks of phase 6, whose states later ones are made of.
    """

    ledger: Ledger
    executor: Executor
    data: str
    threads: int = 1
    seconds: float | None = None
    memory_mb: float | None = None
    on_record: Callable[[Record, bool], None] | None = None
    on_orders: Callable[[list[str], list[TrainingRequest]], None] | None = None
    teacher_keys: set[str] = field(default_factory=set)

    def __call__(self, orders: list[TrainingRequest]) -> list[Outcome]:
        """Outcomes in the order of the orders; equal orders are done once.

        Parts of trainings go on from the latest part before them whose state is still there. Once a batch is trained,
        states of other batches are not needed any more and removed.
        """
        jobs = [self._job(order) for order in orders]
        if self.on_orders is not None:
            self.on_orders([job.key for job in jobs], orders)
        # Asked before the trainings: afterwards every record is there.
        new = any(self.ledger.finished(job.key) is None for job in jobs)
        records_by_key = complete(
            self.ledger, self.executor, [self._begun(*pair) for pair in zip(jobs, orders)], self.on_record
        )
        self.teacher_keys.update(job.key for job, order in zip(jobs, orders) if order.recipe is not None)
        # A search that goes on comes by earlier batches first, and one that stops here needs what it had.
        if new and all(record.status in FINAL for record in records_by_key.values()):
            self.ledger.keep_states({*self.teacher_keys, *(job.key for job in jobs)})
        records = [records_by_key[job.key] for job in jobs]
        return [Outcome(o, str(r.status), r.result, r.message) for o, r in zip(orders, records)]

    def _job(self, order: TrainingRequest) -> Job:
        return job_of(order, self.data, self.threads, self.seconds, self.memory_mb)

    def _begun(self, job: Job, order: TrainingRequest) -> Job:
        """The job with the state from which it goes on, where there is one."""
        if self.ledger.finished(job.key):
            return job
        # The latest rung saves most of the training.
        earlier = [replace(order, until=stop, stops=()) for stop in reversed(order.stops)]
        for one in [*earlier, *before(order)]:
            file = self.ledger.state(self._job(one).key)
            if file is not None:
                return replace(job, where={**job.where, START: str(file)})
        return job
