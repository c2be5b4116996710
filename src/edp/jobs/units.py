"""Units of work: pieces of a command that a process or a node may do alone, found by the content of what they do.

A unit is a job like a training: a function by name, called with what decides its result and with where things are. Its
key covers function, arguments, data, code, versions and threads; equal units are done once, a worker that is killed
loses at most the unit that it was doing, and what units give back is plain values and bytes in a stated form: nothing
that a unit has read is unpickled.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from edp.errors import EdpError, LostError, StorageError
from edp.jobs.base import START, Executor, Job, Workforce, complete
from edp.storage.ledger import Ledger, Record, TrainingIdentity, TrainingStatus, code_version, read_state
from edp.storage.paths import is_folder_at
from edp.storage.provenance import environment

TRIED_AGAIN = tuple(status for status in TrainingStatus if status is not TrainingStatus.DONE)
"""A full disk or a log that was mended since: only what is done stays done when the command is given again."""


class UnitError(EdpError):
    """A unit of work failed; the message names it and says why."""


@dataclass(frozen=True)
class WorkUnit:
    """A piece of work.

    Attributes:
        function: ``package.module:name``, called as ``function(identity, where)``; its arguments are
            ``identity.config``. It returns plain values, or these with bytes (`edp.storage.ledger.WithState`).
        label: for messages.
        arguments: plain values that decide the result.
        data: digest of what it reads.
        where: where things are; the same paths on every node.
    """

    function: str
    label: str
    arguments: Mapping[str, Any]
    data: str = ""
    where: Mapping[str, Any] = field(default_factory=dict)

    def job(self, threads: int) -> Job:
        """The unit for an executor."""
        if START in self.where:
            raise ValueError(f"'{START}' of `where` is the state that a training goes on from; name it otherwise")
        identity = TrainingIdentity(
            self.function, self.arguments, {}, 0, 0, code_version(whole=True), self.data, _environment(threads)
        )
        return Job(identity, self.where)


_environment = cache(environment)


@dataclass(frozen=True)
class UnitResult:
    """What a unit gave.

    Attributes:
        values: plain values.
        content: bytes beside them, where it gave some.
        seconds: that it took, and 0 where it was done before.
    """

    values: Mapping[str, Any]
    content: bytes | None = None
    seconds: float = 0.0


def run_units(
    units: Sequence[WorkUnit],
    workforce: Workforce,
    folder: str | Path | None = None,
    on_done: Callable[[WorkUnit, UnitResult, int], None] | None = None,
) -> list[UnitResult]:
    """Have units done; the results in their order.

    Args:
        units: equal ones are done once.
        workforce: who does them.
        folder: where results are kept until the command is done, so that a command that was stopped goes on; None
            keeps them for this call alone.
        on_done: called with each unit, its result and how many are done, in the order in which they end.

    Raises:
        UnitError: one failed; what others gave is kept in `folder`.
        LostError: its process was killed again and again.
        ConfigError: the cluster cannot be used.
    """
    if not units:
        return []
    jobs = [unit.job(workforce.threads) for unit in units]
    by_key = {job.key: unit for job, unit in zip(jobs, units, strict=True)}
    results: dict[str, UnitResult] = {}
    with _ledger(folder) as ledger, workforce.open() as executor:
        ledger.set_aside(TRIED_AGAIN)

        def take(record: Record, done_now: bool) -> None:
            unit = by_key[record.key]
            _refuse_failed(unit, record)
            state = ledger.state(record.key)
            content = None if state is None else read_state(state)
            seconds = float(record.measured.get("seconds", 0.0)) if done_now else 0.0
            results[record.key] = UnitResult(record.result or {}, content, seconds)
            if on_done is not None:
                on_done(unit, results[record.key], len(results))

        complete(ledger, executor, jobs, take)
    return [results[job.key] for job in jobs]


@contextlib.contextmanager
def _ledger(folder: str | Path | None) -> Iterator[Ledger]:
    """The ledger of units: in a folder that stays, or for the time of the block."""
    if folder is not None:
        with Ledger(folder) as ledger:
            yield ledger
        return
    with tempfile.TemporaryDirectory(prefix="edp-units-") as temporary, Ledger(temporary) as ledger:
        yield ledger


def forget_units(folder: str | Path) -> None:
    """Remove results of units, once what they were for is on disk."""
    if is_folder_at(Path(folder, "records")):
        shutil.rmtree(folder, ignore_errors=True)


def _refuse_failed(unit: WorkUnit, record: Record) -> None:
    if record.status is TrainingStatus.DONE:
        return
    if record.status is TrainingStatus.LOST:
        raise LostError(f"{unit.label}: {record.message}; give the same command again to go on")
    if "No space left" in record.message:
        raise StorageError(f"{unit.label}: {record.message}")
    raise UnitError(f"{unit.label}: {record.message}")


__all__ = ["Executor", "UnitError", "UnitResult", "WorkUnit", "forget_units", "run_units"]
