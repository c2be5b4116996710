"""What the phases of a search call to have their orders done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from edp.ledger import Ledger, Record
from edp.search.batch import complete
from edp.search.executor import Executor
from edp.search.ground import Outcome
from edp.search.jobs import job_of
from edp.search.trainings import Order


@dataclass(frozen=True)
class Doing:
    """Has the orders of a phase done: what `edp.search.conduct` calls.

    Attributes:
        ledger: of the study.
        executor: does what the ledger does not hold.
        data: hash of the recordings.
        threads: of each training; the pool pins as many.
        seconds: cap on the time of a training.
        memory_mb: cap on its memory.
        on_record: told of each record and whether it was trained now.
        on_orders: told of each batch before it is done: keys and orders.
    """

    ledger: Ledger
    executor: Executor
    data: str
    threads: int = 1
    seconds: float | None = None
    memory_mb: float | None = None
    on_record: Callable[[Record, bool], None] | None = None
    on_orders: Callable[[list[str], list[Order]], None] | None = None

    def __call__(self, orders: list[Order]) -> list[Outcome]:
        """Outcomes in the order of the orders; equal orders are done once."""
        jobs = [job_of(order, self.data, self.threads, self.seconds, self.memory_mb) for order in orders]
        if self.on_orders is not None:
            self.on_orders([job.key for job in jobs], orders)
        found = complete(self.ledger, self.executor, jobs, self.on_record)
        records = [found[job.key] for job in jobs]
        return [Outcome(o, str(r.status), r.result, r.message) for o, r in zip(orders, records)]
