"""Jobs and executors: local pool and cluster have the same interface, and every job ends with a record."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

from edp.errors import ConfigError, count_of
from edp.storage.ledger import Ledger, Record, TrainingIdentity, TrainingStatus

START = "start"
# Two restarts tell bad luck from a fault of the training itself.
RETRIES = 2
"""Number of restarts of a training whose process was killed, before it counts as lost."""


@dataclass(frozen=True)
class Job:
    """A training to be done.

    The function ``identity.job`` is called as ``function(identity, where)`` and returns plain values, or these with a
    state (`edp.storage.ledger.WithState`). What decides its result is in `identity`, so that its key covers it.

    Attributes:
        identity: settings that determine the result.
        where: inputs that do not affect the result, such as paths of recordings. `START` is the key for the file of a
            state to continue from (`edp.storage.ledger.read_state`).
        seconds: cap on its time, from the call of the function on.
        memory_mb: cap on the memory of its process.
        folder: folder of the ledger. If set, the process claims the training there and writes its record and state.
    """

    identity: TrainingIdentity
    where: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    memory_mb: float | None = None
    folder: str | None = None

    @property
    def key(self) -> str:
        """Key of the training."""
        return self.identity.key


class Executor(Protocol):
    """Runs jobs side by side."""

    @property
    def workers(self) -> int:
        """How many jobs run side by side."""
        ...

    def submit(self, job: Job) -> None:
        """Take a job; it starts when a worker is free, in the order of submission.

        Raises:
            ConfigError: the same training was submitted and has not finished.
        """
        ...

    def wait_any(self, timeout_s: float | None = None) -> Record | None:
        """Wait for the next finished training and return it; None after the timeout or without running trainings."""
        ...

    def cancel(self, key: str) -> None:
        """Stop a job or remove it from the queue, without a record."""
        ...

    def running(self) -> list[str]:
        """Return the keys of the jobs under way; the others that were submitted wait."""
        ...

    def close(self) -> None:
        """Stop everything."""
        ...

    def __enter__(self) -> Self:
        """Return the executor."""
        ...

    def __exit__(self, *_: object) -> None:
        """Stop everything."""
        ...


class ClosedAtExit:
    """Base of executors that stop all jobs at the end of a ``with`` block."""

    def close(self) -> None:
        """Stop everything."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """Return the pool; leaving the block stops it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop everything."""
        self.close()


def ended(job: Job, status: TrainingStatus, message: str, **measured: Any) -> Record:
    """Return the record of a job that could not report its own end."""
    return Record(job.identity, status, None, message, {"host": platform.node(), **measured})


def refuse_twice(job: Job, under_way: Mapping[str, Any]) -> None:
    """Raise `ConfigError` where a training is under way already."""
    if job.key in under_way:
        raise ConfigError(f"training {job.key} was submitted twice; wait for it, equal trainings give equal results")


@dataclass(frozen=True)
class JobEnd:
    """End of a job, and whether the job was done now or by an earlier command."""

    record: Record
    is_new: bool


def iterate_ends(
    ledger: Ledger, executor: Executor, jobs: Iterable[Job], wake_s: float | None = None
) -> Iterator[JobEnd | None]:
    """Yield the end of every job: results in the ledger first, others as soon as they end.

    Args:
        ledger: ledger of the study. Each record is on disk before it is yielded.
        executor: does what the ledger does not hold; jobs of others that it runs must not come back meanwhile.
        jobs: equal ones are done once.
        wake_s: interval after which None is yielded while jobs are under way; None: never.

    Raises:
        StorageError: a record could not be written; what ran is stopped, and what was entered stays.
    """
    # Equal jobs share a key and are trained once.
    jobs_by_key = {job.key: job for job in jobs}
    waiting: set[str] = set()
    try:
        for key, job in jobs_by_key.items():
            finished_record = ledger.finished(key)
            if finished_record is None:
                executor.submit(replace(job, folder=str(ledger.path)))
                waiting.add(key)
            else:
                yield JobEnd(finished_record, False)
        while waiting:
            # Everything is submitted before the first wait, so that no worker is idle while others train.
            record = executor.wait_any(wake_s)
            if record is None:
                if wake_s is None or not executor.running():
                    raise RuntimeError(f"the executor gave up {count_of(len(waiting), 'training')} without a word")
                yield None
                continue
            waiting.discard(record.key)
            # Into the ledger before anybody hears of it: what was told must survive a kill.
            ledger.put(record)
            yield JobEnd(record, True)
    finally:
        # An exception or an interrupt must not leave trainings running that nobody waits for.
        for key in waiting:
            executor.cancel(key)


def complete(
    ledger: Ledger, executor: Executor, jobs: Sequence[Job], on_record: Callable[[Record, bool], None] | None = None
) -> dict[str, Record]:
    """Return the records of all jobs by key, in the order of the jobs.

    Args:
        ledger: see `iterate_ends`.
        executor: see `iterate_ends`.
        jobs: see `iterate_ends`.
        on_record: called with each record and whether it was trained now.

    Raises:
        StorageError: see `iterate_ends`.
    """
    records: dict[str, Record] = {}
    for end in iterate_ends(ledger, executor, jobs):
        if end is not None:
            records[end.record.key] = end.record
            if on_record is not None:
                on_record(end.record, end.is_new)
    return {job.key: records[job.key] for job in jobs}
