"""Jobs side by side in processes of this machine, which help this one and end with it."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import Protocol, TypeVar

from edp.errors import EdpError
from edp.sandbox.processes import begin_helper, choose_socket_folder


class Labelled(Protocol):
    """A job with a name for messages."""

    @property
    def label(self) -> str:
        """The name."""
        ...


POLL_S = 0.5
"""Between two looks at jobs that are at work."""
Job = TypeVar("Job", bound=Labelled)
Result = TypeVar("Result")


class Helpers:
    """Processes that do jobs; they start with the first jobs that need them, and end with the block.

    Args:
        workers: processes; with 1 the jobs are done in this one.
        died: error for the label of a job whose process died.
    """

    def __init__(self, workers: int, died: Callable[[str], EdpError]) -> None:
        self.workers, self.died = workers, died
        self._pool: ProcessPoolExecutor | None = None
        self._others = set(multiprocessing.active_children())

    def __enter__(self) -> Helpers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is None:
            return
        if kind is not None:  # stopped or failed: nobody waits for what they are at
            for child in set(multiprocessing.active_children()) - self._others:
                child.terminate()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def ordered(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], waiting: Callable[[], None] | None = None
    ) -> Iterator[Result]:
        """Yield the result of `function` for each job, in the order of the jobs.

        Args:
            function: that a process can import.
            jobs: what it is called with.
            waiting: called now and then while a process is at work.

        Raises:
            EdpError: a process died, see `died`.
        """
        if self.workers <= 1 or len(jobs) <= 1:
            yield from map(function, jobs)
            return
        running: deque[tuple[Job, Future[Result]]] = deque()
        for job in jobs:
            running.append((job, self._started().submit(function, job)))
            # At most two a worker: finished results must not pile up in memory while an early one is late.
            if len(running) >= 2 * self.workers:
                yield self._result(*running.popleft(), waiting)
        while running:
            yield self._result(*running.popleft(), waiting)

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            # Spawned rather than forked: a forked child may inherit locks of threads that do not exist in it.
            context = multiprocessing.get_context("spawn")
            choose_socket_folder()
            self._pool = ProcessPoolExecutor(self.workers, context, begin_helper, (os.getpid(),))
        return self._pool

    def _result(self, job: Job, future: Future[Result], waiting: Callable[[], None] | None) -> Result:
        while waiting is not None and not wait([future], POLL_S).done:
            waiting()
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise self.died(job.label) from error
