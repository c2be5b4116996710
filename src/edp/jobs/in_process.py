"""Jobs in this process, one after the other: no process is started, and what a job needs to load is loaded once."""

from __future__ import annotations

from collections import deque

from edp.jobs.base import EXECUTORS, ClosedAtExit, Executor, Job, Workforce, refuse_twice
from edp.jobs.perform import perform
from edp.storage.ledger import Record


class InProcess(ClosedAtExit):
    """Executor that runs a job in this process when its result is requested; see `edp.jobs.base.Executor`.

    Caps on time and memory, which only a second process could hold a job to, are those of the pools.
    """

    workers = 1

    def __init__(self) -> None:
        self._queue: deque[Job] = deque()

    def submit(self, job: Job) -> None:
        """Take a job; see `Executor.submit`."""
        refuse_twice(job, {one.key: one for one in self._queue})
        self._queue.append(job)

    def running(self) -> list[str]:
        """Nothing is under way between two calls."""
        return []

    def wait_any(self, timeout_s: float | None = None) -> Record | None:
        """Do the next job; the time cannot end it."""
        if not self._queue:
            return None
        job = self._queue.popleft()
        return perform(job.identity, job.where, job.folder, lambda: None)

    def cancel(self, key: str) -> None:
        """Drop a job; see `Executor.cancel`."""
        self._queue = deque(job for job in self._queue if job.key != key)

    def close(self) -> None:
        """Drop everything."""
        self._queue.clear()


@EXECUTORS.register("local")
def in_this_process(workforce: Workforce) -> Executor:
    """This process."""
    return InProcess()
