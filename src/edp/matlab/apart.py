"""The side that asks: one helper process is kept for all MAT files that this process reads.

The helper is a fresh interpreter (`edp.matlab.child`), never a fork of this process, whose threads a fork would break.
Its answers come through a pipe.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from edp.errors import DataError
from edp.matlab.found import Found
from edp.matlab.wire import receive

_CHILD = ("-P", "-m", "edp.matlab.child")
_PIPE_BYTES = 1 << 20
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_SIGNAL_CODE = 128
_TIMERS = tuple(int(getattr(signal, name, -1)) for name in ("SIGPROF", "SIGALRM"))
_END_S = 5.0
_TRIES = 2
"""A helper that has been idle may end, or something kill it, in the moment in which it is asked."""
_lock = threading.Lock()
_helper: _Helper | None = None


def unpack(path: Path, variable: str | None = None) -> Found:
    """Everything in a MAT file, or in one variable of it.

    Raises:
        DataError: the file is damaged, so that a library crashes, hangs or wants more memory than it may have;
            or no process can be started.
    """
    global _helper
    for _ in range(_TRIES):
        with _lock:
            if _helper is None or _helper.process.poll() is not None:
                _drop()
                _helper = _Helper()
            answer = _helper.ask(path, variable)
            code, said = (0, "") if answer is not None else _helper.last_words()
        if isinstance(answer, Found):
            return answer
        if answer is not None:
            raise DataError(answer)
        if code > 0:
            raise DataError(_died(path, code, said))
    raise DataError(f"'{path}' cannot be read: the process that reads MAT files is ended by something; try again")


def end() -> None:
    """End the helper process, if there is one; the next file starts another."""
    with _lock:
        _drop()


def _drop() -> None:
    global _helper
    if _helper is not None:
        _helper.close()
    _helper = None


def _forget() -> None:
    """In a fork of this process: its ends of the pipes are shared with its parent, and must not be used."""
    global _helper, _lock
    _lock = threading.Lock()
    if _helper is not None:
        _helper.process.returncode = 0
    _helper = None


def _died(path: Path, code: int, said: str) -> str:
    advice = "it is damaged, copy or export it again"
    if code - _SIGNAL_CODE in _TIMERS:
        return f"'{path}' cannot be read as a MAT file: its library finds no end in it; {advice}"
    if code > _SIGNAL_CODE:
        number = code - _SIGNAL_CODE
        return f"'{path}' cannot be read as a MAT file: its library crashes on it (signal {number}); {advice}"
    last = said.splitlines()[-1] if said else f"exit code {code}"
    return f"'{path}' cannot be read: the process that reads MAT files failed ({last})"


class _Helper:
    """A running helper."""

    def __init__(self) -> None:
        self.output = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        places = os.pathsep.join(place for place in sys.path if place)
        try:
            self.process = subprocess.Popen(
                [sys.executable, *_CHILD],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self.output,
                bufsize=0,
                env=os.environ | dict.fromkeys(_THREADS, "1") | {"PYTHONPATH": places},
                start_new_session=True,  # Ctrl-C is for the process that asks
            )
        except OSError as error:
            self.output.close()
            raise DataError(f"no process can be started to read MAT files ({error}); free some memory") from error
        orders, answers = self.process.stdin, self.process.stdout
        if orders is None or answers is None:
            raise RuntimeError("a process was started without the pipes asked for")
        self.orders, self.answers = orders, answers
        with contextlib.suppress(ImportError, AttributeError, OSError):
            import fcntl

            fcntl.fcntl(answers.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def ask(self, path: Path, variable: str | None) -> Found | str | None:
        """What was found, or what is wrong with the file; None where the helper is gone."""
        try:
            folder = os.getcwd()
        except FileNotFoundError:
            folder = os.sep
        order = json.dumps({"path": str(path), "folder": folder, "variable": variable})
        try:
            self.orders.write(order.encode() + b"\n")
            return receive(self._read_into)
        except (EOFError, BrokenPipeError):
            return None
        except BaseException:
            # Half an answer may still be under way.
            self.kill()
            raise

    def _read_into(self, view: memoryview) -> None:
        while view:
            count = self.answers.readinto(view)  # type: ignore[attr-defined]
            if not count:
                raise EOFError
            view = view[count:]

    def last_words(self) -> tuple[int, str]:
        """The exit code of a helper that is gone, and what it printed."""
        code = self.process.wait()
        self.output.seek(0)
        return code, self.output.read().decode(errors="replace").strip()

    def kill(self) -> None:
        """Kill the process and its forks."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(self.process.pid, signal.SIGKILL)
            else:
                self.process.kill()
        self.process.wait()

    def close(self) -> None:
        """End it: without standard input it ends by itself."""
        with contextlib.suppress(OSError):
            self.orders.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self.answers.close()
        self.output.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
atexit.register(end)
