"""Trainings through the ledger: what it holds is not done again; an executor does the rest, entered at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from edp.storage.ledger import Ledger, Record
from edp.workflows.search.executor import Executor, Job


def complete(
    ledger: Ledger, executor: Executor, jobs: Iterable[Job], on_record: Callable[[Record, bool], None] | None = None
) -> dict[str, Record]:
    """The records of all jobs by key, in the order of the jobs.

    Args:
        ledger: of the study; each training is on disk before `on_record` hears of it.
        executor: does what the ledger does not hold; jobs of others that it runs must not come back meanwhile.
        jobs: equal ones are done once.
        on_record: called with each record and whether it was trained now.

    Raises:
        StorageError: a record could not be written; what ran is stopped, and what was entered stays.
    """
    tell = on_record or (lambda record, trained: None)
    # Equal jobs share a key and are trained once.
    jobs_by_key = {job.key: job for job in jobs}
    records: dict[str, Record] = {}
    waiting: set[str] = set()
    try:
        for key, job in jobs_by_key.items():
            finished_record = ledger.finished(key)
            if finished_record is not None:
                records[key] = finished_record
                tell(finished_record, False)
            else:
                executor.submit(replace(job, folder=str(ledger.path)))
                waiting.add(key)
        while waiting:
            # Everything is submitted before the first wait, so that no worker is idle while others train.
            record = executor.wait_any()
            if record is None:
                raise RuntimeError(f"the executor gave up {len(waiting)} trainings without a word")
            waiting.discard(record.key)
            # Into the ledger before anybody hears of it: what was told must survive a kill.
            ledger.put(record)
            records[record.key] = record
            tell(record, True)
    finally:
        # An exception or an interrupt must not leave trainings running that nobody waits for.
        for key in waiting:
            executor.cancel(key)
    return {key: records[key] for key in jobs_by_key}
