"""Orders of the phases through ledger and executor."""

from __future__ import annotations

from collections.abc import Callable

from edp.ledger import Ledger, Record
from edp.search.batch import complete
from edp.search.conduct import Do
from edp.search.executor import Executor
from edp.search.ground import Outcome
from edp.search.jobs import job_of
from edp.search.trainings import Order


def through_ledger(
    ledger: Ledger,
    executor: Executor,
    data: str,
    caps: tuple[float | None, float | None] = (None, None),
    on_record: Callable[[Record, bool], None] | None = None,
) -> Do:
    """What does orders for `edp.search.conduct.conduct`: those that the ledger holds are not done again.

    Args:
        ledger: of the search.
        executor: does the others.
        data: hash of the recordings.
        caps: seconds and megabytes that a training may take; None for no cap.
        on_record: told of each record and whether it was trained now.
    """

    def do(orders: list[Order]) -> list[Outcome]:
        jobs = [job_of(order, data, seconds=caps[0], memory_mb=caps[1]) for order in orders]
        records = complete(ledger, executor, jobs, on_record)
        return [_outcome(order, records[job.key]) for order, job in zip(orders, jobs, strict=True)]

    return do


def _outcome(order: Order, record: Record) -> Outcome:
    return Outcome(order, str(record.status), record.result, record.message)
