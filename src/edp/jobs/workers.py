"""Units of work, executed by this process, by several processes of this machine, or by a Ray cluster.

A unit names a function. The function receives the arguments that determine the result, and the places of its data.
The key of a unit covers function, arguments, data, code, versions and threads. A folder of results makes a loop over
units resumable: a stopped command executes only the missing units when it is given again. Results are plain values and
bytes in a stated form, so that data which a unit has read are never unpickled.
"""

from __future__ import annotations

import contextlib
import importlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from edp.errors import ConfigError, EdpError, LostError, StorageError
from edp.jobs.base import START, Executor, Job, JobEnd, iterate_ends
from edp.jobs.cluster import RayPool
from edp.jobs.perform import call
from edp.jobs.processes import LocalPool
from edp.progress import SILENT, Progress
from edp.settings.bounds import MAX_THREADS, check_bounds, integer
from edp.storage.ledger import (
    Ledger,
    Record,
    TrainingIdentity,
    TrainingStatus,
    code_version,
    leave_state,
    read_state,
)
from edp.storage.paths import is_folder_at
from edp.storage.portable import cores
from edp.storage.provenance import environment

UNITS = "units"
"""Folder of the results of completed units in a run folder, until the run is finished."""
TRIED_AGAIN = tuple(status for status in TrainingStatus if status is not TrainingStatus.DONE)
"""Statuses of units that a repeated command runs again. A full disk or a faulty log may have been repaired."""
PROGRESS = "progress"
"""Key of `where` for the progress display to which the stages of a unit in this process belong."""
WAKE_S = 0.5
"""Interval between calls of `waiting` while processes run, s."""


class UnitError(EdpError):
    """Failure of a unit of work in another process; the message names the unit and the reason."""


@dataclass(frozen=True)
class WorkUnit:
    """Unit of work.

    Attributes:
        function: ``package.module:name``, called as ``function(identity, where)``; its arguments are
            ``identity.config``. It returns plain values, or these with bytes (`edp.storage.ledger.WithState`).
        label: name for messages.
        arguments: plain values that decide the result.
        data: digest of what it reads.
        where: inputs, or their paths, which are the same on every node.
        size: number by which the progress counts the unit.
    """

    function: str
    label: str
    arguments: Mapping[str, Any]
    data: str = ""
    where: Mapping[str, Any] = field(default_factory=dict)
    size: int = 1

    def job(self, threads: int) -> Job:
        """Return the unit as a job of an executor."""
        if START in self.where:
            raise ValueError(f"'{START}' of `where` is the state that a training goes on from; name it otherwise")
        return Job(self.identity(code_version(whole=True), _environment(threads)), self.where)

    def identity(self, code: str = "", environment: Mapping[str, str] | None = None) -> TrainingIdentity:
        """Return the arguments of the unit's function; a key needs code and environment."""
        return TrainingIdentity(self.function, self.arguments, {}, 0, 0, code, self.data, environment or {})


_environment = cache(environment)


@dataclass(frozen=True)
class UnitResult:
    """Result of a unit.

    Attributes:
        values: plain values.
        content: bytes in addition, if the unit returned some.
        seconds: duration.
        is_new: whether it was done now, and not by an earlier command.
    """

    values: Mapping[str, Any]
    content: bytes | None = None
    seconds: float = 0.0
    is_new: bool = True


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Processes that execute the units of a command.

    Attributes:
        count: number of processes of this machine; 1 for this process alone, 0 for the number of cores divided by
            `threads`.
        threads: number of threads per unit; another number may change the last bits of results.
        cluster: address of a Ray cluster that is used instead; empty for this machine.
        open_cluster: accept a cluster without a token at an address that other computers may reach.
        executor: open processes or connection, see `stay`.

    Raises:
        ConfigError: a number out of range, or workers of this machine and a cluster.
    """

    count: int = 1
    threads: int = 1
    cluster: str = ""
    open_cluster: bool = False
    executor: Executor | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_bounds("workers", self, count=integer(0, MAX_THREADS), threads=integer(1, MAX_THREADS))
        if self.cluster and self.count > 1:
            raise ConfigError(
                f"workers: got {self.count} and the cluster '{self.cluster}', expected one of the two; leave the "
                "number of workers out, since a cluster has one for each of its cores"
            )

    @property
    def processes(self) -> int:
        """Number of processes of this machine."""
        return self.count or max(1, cores() // self.threads)

    @property
    def are_alone(self) -> bool:
        """Whether this process executes all units."""
        return not self.cluster and self.processes == 1

    def open(self) -> Executor:
        """Return a new executor; close it, preferably by a ``with`` block.

        Raises:
            ConfigError: a cluster that does not answer, is open, or has other versions.
        """
        if self.cluster:
            return RayPool(self.cluster, self.threads, open_cluster=self.open_cluster)
        return LocalPool(self.processes, self.threads)

    @contextlib.contextmanager
    def stay(self) -> Iterator[Workers]:
        """Keep processes and connections between several calls of `map` within a ``with`` block."""
        if self.are_alone or self.executor is not None:
            yield self
            return
        with self.open() as executor:
            yield replace(self, executor=executor)

    def map(
        self,
        units: Sequence[WorkUnit],
        progress: Progress = SILENT,
        folder: Path | None = None,
        waiting: Callable[[], None] | None = None,
    ) -> Iterator[tuple[int, UnitResult]]:
        """Execute units, and yield the index and the result of each unit when it ends.

        Args:
            units: equal units are executed once if there is a folder or a second process.
            progress: receiver of the label of each unit, and of the number of finished units.
            folder: folder of results; units with a result in it are not executed again. None stores no results.
            waiting: called every `WAKE_S` seconds while other processes work.

        Raises:
            EdpError: error of a unit, also in another process; the results of other units stay in `folder`.
            UnitError: a unit raised an error of another kind in another process.
            LostError: the process of a unit was killed again and again.
            ConfigError: the cluster cannot be used.
        """
        is_alone = self.are_alone or (len(units) == 1 and not self.cluster)
        if is_alone and folder is None:
            results: Iterator[tuple[int, UnitResult]] = _call_all(units, progress)
        else:
            alone = replace(self, count=1, executor=None) if is_alone else self
            results = alone._map_through_ledger(units, progress, folder, waiting)
        done = 0
        for index, result in results:
            done += units[index].size
            progress.step(done)
            yield index, result

    def map_in_order(
        self,
        units: Sequence[WorkUnit],
        progress: Progress = SILENT,
        folder: Path | None = None,
        waiting: Callable[[], None] | None = None,
    ) -> Iterator[UnitResult]:
        """Execute units as by `map`, and yield the results in the order of the units."""
        early: dict[int, UnitResult] = {}
        following = 0
        for index, result in self.map(units, progress, folder, waiting):
            early[index] = result
            while following in early:
                yield early.pop(following)
                following += 1

    def _map_through_ledger(
        self, units: Sequence[WorkUnit], progress: Progress, folder: Path | None, waiting: Callable[[], None] | None
    ) -> Iterator[tuple[int, UnitResult]]:
        if not units:
            return
        numbers: dict[str, list[int]] = {}
        jobs = [unit.job(self.threads) for unit in units]
        for index, job in enumerate(jobs):
            numbers.setdefault(job.key, []).append(index)
        labels = {job.key: unit.label for job, unit in zip(jobs, units, strict=True)}
        with _open_ledger(folder) as ledger:
            ledger.set_aside(TRIED_AGAIN)
            if self.are_alone:
                ends: Iterator[JobEnd | None] = _do_alone(ledger, jobs, labels, progress)
            else:
                ends = self._do_together(ledger, jobs, None if waiting is None else WAKE_S)
            for end in ends:
                if end is None:
                    if waiting is not None:
                        waiting()
                    continue
                key = end.record.key
                if not self.are_alone:
                    _raise_failure(labels[key], end.record)
                    progress.note(labels[key])
                state = ledger.state(key)
                content = None if state is None else read_state(state)
                seconds = float(end.record.measured.get("seconds", 0.0))
                for index in numbers[key]:
                    yield index, UnitResult(end.record.result or {}, content, seconds, end.is_new)

    def _do_together(self, ledger: Ledger, jobs: Sequence[Job], wake_s: float | None) -> Iterator[JobEnd | None]:
        with self.stay() as staying:
            if staying.executor is None:
                raise RuntimeError("workers of several processes have no executor")
            yield from iterate_ends(ledger, staying.executor, jobs, wake_s)


IN_PROCESS: Workers = Workers()
"""Default workers of every workflow, which run in the calling process."""


def _call_all(units: Sequence[WorkUnit], progress: Progress) -> Iterator[tuple[int, UnitResult]]:
    """Execute units in this process without storing results."""
    for index, unit in enumerate(units):
        progress.note(unit.label)
        where = {**unit.where, PROGRESS: progress}
        record, content = call(unit.identity(), where, lambda: None, is_raising=True)
        yield index, UnitResult(record.result or {}, content, float(record.measured["seconds"]))


def _do_alone(
    ledger: Ledger, jobs: Sequence[Job], labels: Mapping[str, str], progress: Progress
) -> Iterator[JobEnd | None]:
    """Execute jobs in this process and store their results in a ledger."""
    for job in {job.key: job for job in jobs}.values():
        record = ledger.finished(job.key)
        if record is not None:
            yield JobEnd(record, False)
            continue
        progress.note(labels[job.key])
        record, state = call(job.identity, {**job.where, PROGRESS: progress}, lambda: None, is_raising=True)
        if state is not None:
            leave_state(ledger.path, job.key, state)
        ledger.put(record)
        yield JobEnd(record, True)


@contextlib.contextmanager
def _open_ledger(folder: Path | None) -> Iterator[Ledger]:
    """Open the ledger of units in a folder, or in a temporary folder for the duration of the block."""
    if folder is not None:
        with Ledger(folder) as ledger:
            yield ledger
        return
    with tempfile.TemporaryDirectory(prefix="edp-units-") as temporary, Ledger(temporary) as ledger:
        yield ledger


def forget_units(folder: str | Path) -> None:
    """Remove the results of units after the final result is on disk."""
    if is_folder_at(Path(folder, "records")):
        shutil.rmtree(folder, ignore_errors=True)


def _raise_failure(label: str, record: Record) -> None:
    """Raise the error of a unit that failed in another process."""
    if record.status is TrainingStatus.DONE:
        return
    if record.status is TrainingStatus.LOST:
        raise LostError(f"{label}: {record.message}; give the same command again to continue")
    if "No space left" in record.message:
        raise StorageError(f"{label}: {record.message}")
    error_type = _error_type(str(record.measured.get("error", "")))
    if error_type is None:
        raise UnitError(f"{label}: {record.message}")
    raise error_type(record.message)


def _error_type(name: str) -> type[EdpError] | None:
    """Return the class of an error of EDP that is made from its message alone; None for any other class."""
    module, _, kind = name.partition(":")
    # The name comes from another process; `__main__` would run a command.
    if not module.startswith("edp.") or module.endswith("__main__"):
        return None
    try:
        error_type = getattr(importlib.import_module(module), kind, None)
    except ImportError:
        return None
    is_plain = isinstance(error_type, type) and issubclass(error_type, EdpError) and "__init__" not in vars(error_type)
    return error_type if is_plain else None
