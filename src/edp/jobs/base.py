"""What runs jobs: jobs in, typed ends out. This process, a pool and a cluster answer to the same three calls.

An executor is one file and one registration in `EXECUTORS`; a `Workforce` says which one is asked for.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

from edp.errors import ConfigError, count_of
from edp.registry import Registry
from edp.settings.bounds import MOST_THREADS, check_bounds, integer
from edp.storage.ledger import Ledger, Record, TrainingIdentity, TrainingStatus
from edp.storage.portable import cores

START = "start"
# Two restarts tell bad luck from a fault of the training itself.
RETRIES = 2
"""How often a training whose process was killed starts again before it counts as lost."""


@dataclass(frozen=True)
class Job:
    """A training to be done.

    The function ``identity.job`` is called as ``function(identity, where)`` and returns plain values, or these with a
    state (`edp.storage.ledger.WithState`). What decides its result is in `identity`, so that its key covers it.

    Attributes:
        identity: what to train.
        where: what the function needs and the result does not depend on, such as where the recordings lie. Under
            `START` the file of a state that it may go on from (`edp.storage.ledger.read_state`).
        seconds: cap on its time, from the call of the function on.
        memory_mb: cap on the memory of its process.
        folder: of the ledger; where given, the process claims the training there and leaves its record, and its state.
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
            ConfigError: the same training was submitted and has not come back.
        """
        ...

    def wait_any(self, timeout_s: float | None = None) -> Record | None:
        """The next training that ended, or None when the time is over or nothing is under way."""
        ...

    def cancel(self, key: str) -> None:
        """Stop a job or take it from the queue; nothing is reported of it any more."""
        ...

    def running(self) -> list[str]:
        """Keys of the jobs under way; the others that were submitted wait."""
        ...

    def close(self) -> None:
        """Stop everything."""
        ...

    def __enter__(self) -> Self:
        """The executor itself."""
        ...

    def __exit__(self, *_: object) -> None:
        """Stop everything."""
        ...


@dataclass(frozen=True, kw_only=True)
class Workforce:
    """Who does the work of a command.

    Attributes:
        workers: processes of this machine, 1 for this process alone, 0 for one to each core over `threads`.
        threads: of each job; another number may give other bits.
        cluster: address of a Ray cluster that does the work instead; empty for this machine.
        open_cluster: take a cluster without a token at an address that other computers may reach.

    Raises:
        ConfigError: a number out of range, or workers of this machine and a cluster.
    """

    workers: int = 1
    threads: int = 1
    cluster: str = ""
    open_cluster: bool = False

    def __post_init__(self) -> None:
        check_bounds("workers", self, workers=integer(0, MOST_THREADS), threads=integer(1, MOST_THREADS))
        if self.cluster and self.workers > 1:
            raise ConfigError(
                f"workers = {self.workers} and the cluster '{self.cluster}' came; a cluster has its own number of "
                "workers, as many as its cores hold: give one of the two"
            )

    @property
    def count(self) -> int:
        """Processes of this machine."""
        return self.workers or max(1, cores() // self.threads)

    @property
    def kind(self) -> str:
        """Name of the executor."""
        return "ray" if self.cluster else "processes" if self.count > 1 else "local"

    @property
    def alone(self) -> bool:
        """Whether this process does everything."""
        return self.kind == "local"

    def open(self) -> Executor:
        """The executor; to be closed, best by a ``with`` block.

        Raises:
            ConfigError: it cannot be had, such as a cluster that does not answer, is open, or has other versions.
        """
        return EXECUTORS[self.kind](self)


EXECUTORS: Registry[Callable[[Workforce], Executor]] = Registry("executor")


class ClosedAtExit:
    """What all executors do at the end of a ``with`` block: they stop everything."""

    def close(self) -> None:
        """Stop everything."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """The pool itself; leaving the block stops it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop everything."""
        self.close()


def ended(job: Job, status: TrainingStatus, message: str, **measured: Any) -> Record:
    """The record of a job that could not say itself how it ended."""
    return Record(job.identity, status, None, message, {"host": platform.node(), **measured})


def refuse_twice(job: Job, under_way: Mapping[str, Any]) -> None:
    """Raise `ConfigError` where a training is under way already."""
    if job.key in under_way:
        raise ConfigError(f"training {job.key} was submitted twice; wait for it, equal trainings give equal results")


def complete(
    ledger: Ledger, executor: Executor, jobs: Iterable[Job], on_record: Callable[[Record, bool], None] | None = None
) -> dict[str, Record]:
    """The records of all jobs by key, in the order of the jobs: what the ledger holds is not done again.

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
                raise RuntimeError(f"the executor gave up {count_of(len(waiting), 'training')} without a word")
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
