"""Process from which readers are forked: libraries are imported once, and each log is read in its own fork.

It is a fresh interpreter with a single thread, so forking is safe here, which it is not in a process that trains. It
never touches a log itself. Orders come as lines of JSON through a socket, each with the ends of two pipes between the
fork and the process that asks. A fork is killed as soon as the other end of its pipes is closed.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field

from edp.sandbox import broker
from edp.sandbox.lockdown import note_libraries
from edp.sandbox.processes import die_with_parent

IDLE_S = 60.0
"""Idle time after which the process ends, s. The next log starts another process."""
END_S = 5.0
"""Time for a process with closed pipes to end before it is killed, s."""
KEPT_CODES = 1024
"""Maximum number of stored exit codes of forks, which bounds the list for data sets with thousands of logs."""
ORDER_BYTES = 1 << 16
"""Number of bytes read at once. Longer orders arrive in several parts."""
Serve = Callable[[int, int], None]
"""Function that serves one log: it reads orders from the first pipe and writes results to the second."""


@dataclass
class _Forks:
    """Running forks, and exit codes that were not requested yet."""

    pids: dict[int, int] = field(default_factory=dict)
    pipes: dict[int, int] = field(default_factory=dict)
    codes: dict[int, int] = field(default_factory=dict)
    imported: int = 0

    def reap(self) -> list[int]:
        """Take note of ended forks; returns their pipes."""
        closed = []
        for number, pid in list(self.pids.items()):
            ended_pid, status = os.waitpid(pid, os.WNOHANG)
            if ended_pid:
                closed.append(self.ended(number, os.waitstatus_to_exitcode(status)))
        return closed

    def ended(self, number: int, code: int) -> int:
        del self.pids[number]
        self.codes[number] = code
        while len(self.codes) > KEPT_CODES:
            del self.codes[next(iter(self.codes))]
        return self.pipes.pop(number)

    def code(self, number: int) -> int | None:
        """Return the exit code of a fork whose pipes are closed; None for a fork that never ran."""
        if number in self.pids:
            pid, until = self.pids[number], time.monotonic() + END_S
            ended_pid, status = os.waitpid(pid, os.WNOHANG)
            while not ended_pid:
                if time.monotonic() > until:
                    os.kill(pid, signal.SIGKILL)
                    ended_pid, status = os.waitpid(pid, 0)
                else:
                    time.sleep(0.005)
                    ended_pid, status = os.waitpid(pid, os.WNOHANG)
            os.close(self.ended(number, os.waitstatus_to_exitcode(status)))
        return self.codes.pop(number, None)


def main(serve: Serve) -> None:
    """Execute orders from the socket on standard input until it closes or stays idle for long."""
    if "--alone" in sys.argv:
        requests, answers = os.dup(0), os.dup(1)
        # What libraries print must not get into the answers.
        os.dup2(2, 1)
        serve(requests, answers)
        return
    orders, forks = socket.socket(fileno=os.dup(0)), _Forks()
    waking, woken = os.pipe()
    os.set_blocking(waking, False)
    os.set_blocking(woken, False)
    # A child's end wakes the poll through a pipe: between the check and the poll a signal alone would be lost.
    signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    poll = select.poll()
    poll.register(orders, select.POLLIN)
    poll.register(waking, select.POLLIN)
    inherited, ending = [orders.fileno(), waking, woken], False
    try:
        while True:
            ready = dict(poll.poll(1000 * IDLE_S))
            if not ready and not forks.pids:
                # An order that came since would be lost with this process: none is taken in any more, so that its
                # sender learns of it and starts another worker, and what had arrived before is still obeyed.
                orders.shutdown(socket.SHUT_RD)
                while _obey(orders, forks, serve, inherited, poll):
                    pass
                poll.unregister(orders)
                if not forks.pids:
                    break
                ending = True
                continue
            with contextlib.suppress(BlockingIOError):
                os.read(waking, 4096)
            for number, pipe in list(forks.pipes.items()):
                if ready.get(pipe, 0) & (select.POLLHUP | select.POLLERR | select.POLLNVAL):
                    os.kill(forks.pids[number], signal.SIGKILL)
                    poll.unregister(pipe)
                    os.waitpid(forks.pids[number], 0)
                    os.close(forks.ended(number, 0))
                    del forks.codes[number]
            for pipe in forks.reap():
                poll.unregister(pipe)
                os.close(pipe)
            if not ending and orders.fileno() in ready and not _obey(orders, forks, serve, inherited, poll):
                break
            if ending and not forks.pids:
                break
    finally:
        for pid in forks.pids.values():
            os.kill(pid, signal.SIGKILL)


def _obey(orders: socket.socket, forks: _Forks, serve: Serve, inherited: list[int], poll: select.poll) -> bool:
    """Execute one order; return False if there are no more."""
    line, handles = _order(orders)
    if not line:
        return False
    order = json.loads(line)
    if "ended" in order:
        before = forks.pipes.get(order["ended"])
        if before is not None:
            poll.unregister(before)
        answer = {"code": forks.code(order["ended"])}
        orders.sendall(json.dumps(answer).encode() + b"\n")
        return True
    requests, answers = handles
    try:
        for module in order["modules"]:
            importlib.import_module(module)
        for library in order["libraries"]:
            # One that is not installed or damaged is reported by the reader that needs it.
            with contextlib.suppress(Exception):
                importlib.import_module(library)
        if len(sys.modules) != forks.imported:
            forks.imported = len(sys.modules)
            note_libraries()
            gc.collect()
            gc.freeze()  # so that collecting garbage in a fork does not copy what it shares
        worker, pid = os.getpid(), os.fork()
    except (OSError, ImportError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os.close(requests)
        os.close(answers)
        return True
    if pid == 0:
        _serve(serve, (requests, answers), [*inherited, *forks.pipes.values()], worker)
    os.close(answers)
    forks.pids[order["open"]], forks.pipes[order["open"]] = pid, requests
    # No event asked for: poll reports hang-ups always, and what is read belongs to the fork.
    poll.register(requests, 0)
    return True


def _order(orders: socket.socket) -> tuple[bytes, list[int]]:
    """Return one line, and the pipes that came with it."""
    try:
        line, handles, _, _ = socket.recv_fds(orders, ORDER_BYTES, 2)
        while line and not line.endswith(b"\n"):
            part = orders.recv(ORDER_BYTES)
            if not part:
                return b"", handles
            line += part
    except ConnectionError:
        return b"", []
    return line, handles


def _serve(serve: Serve, pipes: tuple[int, int], inherited: list[int], worker: int) -> None:
    """Serve one log in the fork, then end the process in every case."""
    code = 1
    try:
        die_with_parent(worker)
        # The pipe belongs to the worker; a fork that wrote to it would wake the worker for nothing.
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        # Pipes of other logs: a fork that kept them open would hide their end from the worker.
        for handle in inherited:
            os.close(handle)
        nothing = os.open(os.devnull, os.O_RDWR)
        for handle in (0, 1, 2):
            os.dup2(nothing, handle)
        os.close(nothing)
        broker.divide(pipes)
        serve(*pipes)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        # Without the worker's handlers at exit, which belong to the worker.
        os._exit(code)
