"""A supervised pool of processes on this machine.

Each worker is a fresh interpreter on a socket of its own. When one dies, only its training starts again; the pools of
the standard library and joblib fail everything that waits. A worker dies with the pool, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any

from edp.errors import ConfigError
from edp.jobs.base import (
    RETRIES,
    ClosedAtExit,
    Job,
    ended,
    refuse_twice,
)
from edp.jobs.perform import BEGUN
from edp.storage.ledger import Record, TrainingStatus
from edp.wording import typed

TICK_S = 0.1
"""Interval of the memory checks of a training, s. Without a memory limit the pool waits for events."""
# Five minutes: imports of torch on a busy machine take their time, and a cap must not end them.
START_S = 300.0
"""Maximum time from the start of a process until it calls the function of its training, s."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
SHOWN_OUTPUT = 2000
PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


@dataclass(frozen=True)
class _Turn:
    """A job, which start of it this is, and whether its process must not have done others."""

    job: Job
    attempt: int = 1
    fresh: bool = False


class _Worker:
    """One process and the job that it does."""

    def __init__(self, threads: int) -> None:
        ours, theirs = socket.socketpair()
        self.connection = Connection(ours.detach())
        self.output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        # Libraries read these when they are loaded, so they are set before the process begins.
        pinned = {name: str(threads) for name in THREADS}
        places = os.pathsep.join(folder for folder in sys.path if folder)
        # `-P`: the working directory must not shadow modules of the library.
        command = [sys.executable, "-P", "-m", "edp.jobs.worker", str(theirs.fileno()), str(os.getpid())]
        try:
            self.process = subprocess.Popen(
                command,
                pass_fds=[theirs.fileno()],
                # No input: a library that asks a question would wait for ever.
                stdin=subprocess.DEVNULL,
                stdout=self.output,
                stderr=self.output,
                env=os.environ | pinned | {"PYTHONPATH": places},
                start_new_session=True,  # Ctrl-C is for the coordinator, which ends its workers in order
            )
        finally:
            theirs.close()
        self.used = self.begun = False
        self.turn: _Turn | None = None
        self.deadline = float("inf")

    def give(self, turn: _Turn) -> None:
        # As bytes: `Connection.send` hands out tensors through sockets, which other processes cannot open.
        self.connection.send_bytes(pickle.dumps((turn.job.identity, dict(turn.job.where), turn.job.folder)))
        self.turn, self.begun, self.deadline = turn, False, time.monotonic() + START_S

    def now(self) -> _Turn:
        """Present job."""
        if self.turn is None:
            raise RuntimeError("an idle worker was taken for a busy one")
        return self.turn

    def resident_mb(self) -> float:
        """Return the memory of the process; 0 when it is gone."""
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_bytes().split()[1]) * PAGE / 2**20
        except (OSError, IndexError):
            return 0.0

    def said(self) -> str:
        """Return the end of the process's output."""
        size = self.output.seek(0, os.SEEK_END)
        self.output.seek(max(0, size - SHOWN_OUTPUT))
        return self.output.read().decode(errors="replace").strip()

    def end(self) -> None:
        """Kill the process and its child processes."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            # The whole process group: a training may have started processes of its own.
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.connection.close()
        self.output.close()


class LocalPool(ClosedAtExit):
    """Runs jobs in processes of this machine; see `edp.jobs.base.Executor`.

    Use it from one thread that lives as long as the pool: on Linux a worker dies with the thread that started it.

    Args:
        workers: processes; they start when there is something to do.
        threads: number of threads of each training. Another number gives other bits, so it belongs in the key.
        retries: maximum number of restarts of a training whose process was killed.
    """

    def __init__(self, workers: int, threads: int = 1, retries: int = RETRIES) -> None:
        if workers < 1 or threads < 1:
            raise ConfigError(
                f"a pool of {workers} workers with {threads} threads each cannot do anything; give 1 or more"
            )
        if sys.platform == "win32":  # where no socket can be handed to a process that is started
            raise ConfigError("worker processes are started in a way that Windows lacks; run in WSL, or on a cluster")
        self.workers, self.threads, self.retries = workers, threads, retries
        # The parent-death signal is tied to the thread that starts the worker.
        self._thread = threading.get_ident()
        self._idle: list[_Worker] = []
        self._busy: dict[str, _Worker] = {}
        self._queue: deque[_Turn] = deque()
        self._jobs: dict[str, Job] = {}
        self._ready: deque[Record] = deque()

    def submit(self, job: Job) -> None:
        """Take a job; see `Executor.submit`."""
        refuse_twice(job, self._jobs)
        if job.memory_mb is not None and sys.platform != "linux":
            raise ConfigError("a cap on memory needs Linux; leave memory_mb out here")
        self._jobs[job.key] = job
        self._queue.append(_Turn(job))
        self._start()

    def running(self) -> list[str]:
        """Return the keys of the jobs under way."""
        return list(self._busy)

    def processes(self) -> list[int]:
        """Process ids of the workers, busy ones first."""
        return [worker.process.pid for worker in [*self._busy.values(), *self._idle]]

    def wait_any(self, timeout_s: float | None = None) -> Record | None:
        """Return the next finished training; see `Executor.wait_any`."""
        until = float("inf") if timeout_s is None else time.monotonic() + timeout_s
        while not self._ready:
            if not self._busy:
                return None
            left = until - time.monotonic()
            if left < 0:
                return None
            self._watch(left)
            self._start()
        record = self._ready.popleft()
        del self._jobs[record.key]
        return record

    def cancel(self, key: str) -> None:
        """Stop a job; see `Executor.cancel`."""
        if self._jobs.pop(key, None) is None:
            return
        self._queue = deque(turn for turn in self._queue if turn.job.key != key)
        self._ready = deque(record for record in self._ready if record.key != key)
        worker = self._busy.pop(key, None)
        if worker is not None:
            worker.end()
        self._start()

    def close(self) -> None:
        """Stop everything; jobs that have not come back are dropped."""
        for worker in [*self._busy.values(), *self._idle]:
            worker.end()
        self._queue.clear()
        self._jobs.clear()
        self._busy.clear()
        self._idle.clear()
        self._ready.clear()

    def _start(self) -> None:
        """Give waiting jobs to free workers."""
        # The workers of another thread would die with it, and nobody would know why.
        if threading.get_ident() != self._thread:
            raise RuntimeError("a LocalPool is used from the thread that made it; its workers would die with this one")
        while self._queue and len(self._busy) < self.workers:
            turn = self._queue[0]
            # A fresh process is asked for; an idle worker makes room, so that memory holds no more processes than
            # workers.
            if turn.fresh and self._idle:
                self._idle.pop().end()
            worker = self._idle.pop() if self._idle and not turn.fresh else _Worker(self.threads)
            try:
                worker.give(turn)
            except OSError:  # killed while it was idle
                worker.end()
                continue
            self._queue.popleft()
            self._busy[turn.job.key] = worker

    def _watch(self, left: float) -> None:
        """Wait for a message, a death or a cap, at most `left` seconds."""
        now = time.monotonic()
        nearest = min(worker.deadline for worker in self._busy.values()) - now
        capped = any(self._jobs[key].memory_mb for key in self._busy)
        # A second at most without a cap: a death without a message is noticed then.
        pause = max(0.0, min(left, nearest, TICK_S if capped else 1.0))
        by_connection: dict[Any, _Worker] = {worker.connection: worker for worker in self._busy.values()}
        for connection in wait(list(by_connection), pause):
            self._hear(by_connection[connection])
        for worker in list(self._busy.values()):
            self._hold_to_caps(worker)

    def _hear(self, worker: _Worker) -> None:
        """Take a message of a busy worker, or its death."""
        turn = worker.now()
        try:
            message = worker.connection.recv_bytes()
        except (EOFError, OSError):
            self._restart(worker)
            return
        if message == BEGUN:
            limit = turn.job.seconds
            worker.begun, worker.deadline = True, float("inf") if limit is None else time.monotonic() + limit
            return
        record = Record.from_bytes(message)
        del self._busy[turn.job.key]
        # The number of attempts is measured, not decided: it is no part of the result.
        self._ready.append(replace(record, measured={**record.measured, "attempts": turn.attempt}))
        worker.turn, worker.used, worker.deadline = None, True, float("inf")
        self._idle.append(worker)

    def _hold_to_caps(self, worker: _Worker) -> None:
        """Kill a job above a limit. A process that ran other jobs may hold their memory, so a new process decides."""
        turn, job = worker.now(), worker.now().job
        if time.monotonic() > worker.deadline:
            if not worker.begun:
                self._restart(worker)
                return
            status, message = TrainingStatus.TIMEOUT, f"it took longer than {typed(job.seconds)} s"
        elif job.memory_mb is not None and worker.resident_mb() > job.memory_mb:
            status, message = TrainingStatus.OOM, f"it took more than {typed(job.memory_mb)} MB of memory"
        else:
            return
        self._drop(worker)
        # Memory of earlier trainings may still be with the process: a fresh one decides.
        if status is TrainingStatus.OOM and worker.used:
            self._queue.appendleft(replace(turn, fresh=True))
        else:
            self._ready.append(ended(job, status, message, attempts=turn.attempt))

    def _restart(self, worker: _Worker) -> None:
        """Start a training whose process ended again, or give it up."""
        turn, last_output = worker.now(), worker.said()
        self._drop(worker)
        # The same training again, first in line: others wait behind it as before.
        if turn.attempt <= self.retries:
            self._queue.appendleft(replace(turn, attempt=turn.attempt + 1))
            return
        code = worker.process.returncode
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        message = f"its process ended {turn.attempt} times, last by {how}" + (f": {last_output}" if last_output else "")
        self._ready.append(ended(turn.job, TrainingStatus.LOST, message, attempts=turn.attempt))

    def _drop(self, worker: _Worker) -> None:
        """End a busy worker; another one takes its place when there is something to do."""
        del self._busy[worker.now().job.key]
        worker.end()
