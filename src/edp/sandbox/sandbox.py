"""Client side of the sandbox: one worker process, from which a process is forked for each opened log."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from edp.errors import DataError
from edp.sandbox.environment import reduce_environment
from edp.sandbox.protocol import Header, packed, reader, receive

PIPE_BYTES = 1 << 20
"""Requested size of the results pipe, bytes. With the usual 64 kB the reader would wait for the receiver too often."""
SMALL_BYTES = 4096
"""Size of a request that fits into every pipe, bytes."""
SLOW_S = 5.0
"""Reading time after which the observer is informed, s."""
REPORT_S = 1
"""Minimum interval between two reports to the observer, s."""
# A fork of a process with threads may hang, so the worker's libraries get one each.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_SMALL_POOL = {"MIMALLOC_ARENA_RESERVE": "65536"}
"""Limit of Arrow's memory pool, KiB. Without it, Arrow reserves a gigabyte for every file."""
_FORKS = hasattr(os, "fork") and hasattr(socket, "send_fds")
_END_S = 5.0
"""Time for a worker without a socket to end by itself, s."""
_TRIES = 2
"""Number of attempts to start a request. An idle worker may end just when a request is sent."""
Watcher = Callable[[Path, float, int], None]
_lock = threading.RLock()
_workers: dict[str, _Worker] = {}
_channels: weakref.WeakSet[WorkerConnection] = weakref.WeakSet()
_watcher: Watcher | None = None


def watch(watcher: Watcher | None) -> None:
    """Have a function called about once a second while a log is read that was opened more than `SLOW_S` ago.

    Args:
        watcher: takes the log, the seconds since it was opened, and its size in bytes; None for nobody.
    """
    global _watcher
    _watcher = watcher


def end() -> None:
    """End the workers, if there are any. The next log starts a new worker; logs that are open can no longer be read."""
    with _lock:
        for name in list(_workers):
            _drop(name)


def open_channel(worker: str, modules: Sequence[str], path: Path, libraries: Sequence[str] = ()) -> WorkerConnection:
    """Start a process that serves one log.

    Args:
        worker: module to run as the worker (``python -m``); its `main` calls `edp.sandbox.sandbox_worker.main`.
        modules: modules to import before the fork.
        path: the log, for messages.
        libraries: optional libraries to import before the fork if they are installed.

    Raises:
        DataError: no process can be started.
    """
    if not _FORKS:
        return _alone(worker, path)
    order = {"modules": list(modules), "libraries": list(libraries)}
    for attempt in range(_TRIES):
        with _lock:
            running_worker = _workers.get(worker)
            if running_worker is None or running_worker.process.poll() is not None:
                _drop(worker)
                # One that has been idle ends by itself, so each order may need a new one.
                running_worker = _workers[worker] = _Worker(worker)
            try:
                return running_worker.open(order, path)
            except OSError as error:
                code, last_words = running_worker.last_words()
                _drop(worker)
                if attempt == _TRIES - 1:
                    raise DataError(_describe_failure(path, last_words or str(error) or f"exit code {code}")) from error
    raise RuntimeError("unreachable")


def _describe_failure(path: Path, why: str) -> str:
    last = why.strip().splitlines()[-1] if why.strip() else "it ended"
    return f"'{path}' cannot be read: the process that reads logs failed ({last})"


def _drop(name: str) -> None:
    worker = _workers.pop(name, None)
    if worker is not None:
        worker.close()


def _forget() -> None:
    """Forget the pipes in a fork of this process, which shares them with its parent and must not use them."""
    global _lock, _workers
    _lock = threading.RLock()
    # Not waited for: they are children of the parent process, not of this fork.
    for worker in _workers.values():
        worker.process.returncode = 0
        worker.orders.close()
        worker.output.close()
    _workers = {}
    for channel in list(_channels):
        channel.forget()


def _environment() -> dict[str, str]:
    places = os.pathsep.join(entry for entry in sys.path if entry)
    return {**reduce_environment(), **dict.fromkeys(_THREADS, "1"), **_SMALL_POOL, "PYTHONPATH": places}


def _start(worker: str, arguments: Sequence[str], **pipes: Any) -> subprocess.Popen[bytes]:
    # -P: a module of the current folder must not take the place of a library's.
    command = [sys.executable, "-P", "-m", worker, *arguments]
    try:
        # A session of its own: Ctrl-C is for the process that asks.
        return subprocess.Popen(command, bufsize=0, env=_environment(), start_new_session=True, **pipes)
    except OSError as error:
        raise DataError(f"no process can be started to read logs ({error}); free some memory") from error


class _Worker:
    """A running worker."""

    def __init__(self, module: str) -> None:
        self.numbers = itertools.count()
        self.output = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        self.orders, theirs = socket.socketpair()
        with theirs:
            self.process = _start(module, (), stdin=theirs, stdout=subprocess.DEVNULL, stderr=self.output)

    def open(self, order: Header, path: Path) -> WorkerConnection:
        """Have a process forked.

        Raises:
            OSError: the worker is gone.
        """
        number = next(self.numbers)
        theirs_read, requests = os.pipe()
        answers, theirs_write = os.pipe()
        try:
            line = json.dumps(order | {"open": number}).encode() + b"\n"
            socket.send_fds(self.orders, [line], [theirs_read, theirs_write])
        except BaseException:
            os.close(requests)
            os.close(answers)
            raise
        finally:
            os.close(theirs_read)
            os.close(theirs_write)
        with contextlib.suppress(ImportError, AttributeError, OSError):
            import fcntl

            fcntl.fcntl(answers, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        return WorkerConnection(requests, answers, path, lambda: self.ended(number))

    def ended(self, number: int) -> tuple[int | None, str]:
        """Return the exit code of a forked process, negative for a signal, and the output of the worker."""
        with _lock:
            try:
                self.orders.sendall(json.dumps({"ended": number}).encode() + b"\n")
                answer = b""
                while not answer.endswith(b"\n"):
                    part = self.orders.recv(4096)
                    if not part:
                        return self.last_words()
                    answer += part
            except OSError:
                return self.last_words()
            code = json.loads(answer)["code"]
            return code, "" if code is not None else self.said()

    def last_words(self) -> tuple[int, str]:
        """Return the exit code of a worker that has ended, and its output."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(_END_S)
        return 1, self.said() or f"the worker ended with exit code {self.process.returncode}"

    def said(self) -> str:
        if self.output.closed:
            return ""
        self.output.seek(0)
        return self.output.read().decode(errors="replace").strip()

    def close(self) -> None:
        """End it: without its socket it ends by itself, and its forks with it."""
        self.orders.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.output.close()


def _alone(worker: str, path: Path) -> WorkerConnection:
    """Start a worker for this log only, on systems without fork."""
    output = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
    process = _start(worker, ("--alone",), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=output)
    if process.stdin is None or process.stdout is None:
        raise RuntimeError("a process was started without the pipes asked for")
    requests, answers = os.dup(process.stdin.fileno()), os.dup(process.stdout.fileno())
    process.stdin.close()
    process.stdout.close()

    def ended() -> tuple[int | None, str]:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        output.seek(0)
        return process.returncode, output.read().decode(errors="replace").strip()

    channel = WorkerConnection(requests, answers, path, ended)
    weakref.finalize(channel, _reap, process, output)
    return channel


def _reap(process: subprocess.Popen[bytes], output: Any) -> None:
    process.kill()
    process.wait()
    output.close()


class WorkerConnection:
    """Pipes to the process that serves one log; closed when unreferenced."""

    def __init__(self, requests: int, answers: int, path: Path, ended: Callable[[], tuple[int | None, str]]) -> None:
        self.path = path
        self.size = 0
        self.started = time.monotonic()
        self.reported_at = 0.0
        self.answers = answers
        self.requests = requests
        self._ended = ended
        self._read_into = reader(answers)
        self._close = weakref.finalize(self, _close, requests, answers)
        # At the end of the process the system closes the pipes by itself.
        self._close.atexit = False
        self.gone = ""
        _channels.add(self)

    def close(self, why: str = "it was closed") -> None:
        """End the process."""
        self.gone = self.gone or why
        self._close()

    def forget(self) -> None:
        """Close everything shared with the process that opened the log; called in a fork."""
        self.close("it was opened before this process was forked; open it again")

    def send(self, header: Header) -> None:
        """Send a request.

        Raises:
            DataError: the process is gone.
        """
        self._check()
        view = memoryview(packed(header))
        try:
            while view:
                view = view[os.write(self.requests, view) :]
        except BrokenPipeError:
            raise self.lost() from None
        except BaseException:
            self.close("its reading was interrupted; open it again")
            raise

    def receive(self, most: int = 0) -> tuple[Header, list[NDArray[Any]]]:
        """Receive a response with at most `most` bytes of array data.

        Raises:
            DataError: the process is gone, or answers what it may not.
        """
        self._check()
        try:
            if _watcher is not None:
                self._wait(_watcher)
            return receive(self._read_into, most)
        except EOFError:
            raise self.lost() from None
        except (ValueError, MemoryError) as error:
            self.close("its reading failed; open it again")
            if isinstance(error, MemoryError):
                raise
            raise DataError(f"'{self.path}' cannot be read: the process that reads it answered with {error}") from error
        except BaseException:
            # Half an answer may still be under way.
            self.close("its reading was interrupted; open it again")
            raise

    def _check(self) -> None:
        if self.gone:
            raise DataError(f"'{self.path}' cannot be read: {self.gone}")

    def _wait(self, watcher: Watcher) -> None:
        """Call the watcher until a response arrives."""
        if not hasattr(select, "poll"):
            return
        poll = select.poll()
        poll.register(self.answers, select.POLLIN)
        came: list[tuple[int, int]] = []
        while not came:
            came = poll.poll(1000 * REPORT_S)
            now = time.monotonic()
            if now - self.started > SLOW_S and now - self.reported_at >= REPORT_S:
                self.reported_at = now
                watcher(self.path, now - self.started, self.size)

    def lost(self) -> DataError:
        """Return the error for a process that ended."""
        code, last_words = self._ended()
        error = DataError(_describe_death(self.path, code, last_words))
        self.close("reading it failed before; open it again")
        return error


def _describe_death(path: Path, code: int | None, last_words: str) -> str:
    advice = "it may be damaged: copy or export it again"
    if code is None or code >= 0:
        return _describe_failure(path, last_words or f"exit code {code}")
    number = -code
    if number in [int(getattr(signal, name, -1)) for name in ("SIGPROF", "SIGALRM", "SIGXCPU")]:
        return (
            f"'{path}' cannot be read: it takes more processor time than a file of its size and with its headers may "
            f"(its library finds no end in it); {advice}"
        )
    if number == int(getattr(signal, "SIGKILL", -1)):
        return (
            f"'{path}' cannot be read: the system ended the process that reads it (signal 9), mostly for lack of "
            "memory; free some memory and try again"
        )
    return f"'{path}' cannot be read: its library crashes on it (signal {number}); {advice}"


def _close(*handles: int) -> None:
    for handle in handles:
        with contextlib.suppress(OSError):
            os.close(handle)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
atexit.register(end)
