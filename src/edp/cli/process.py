"""The process of a command: threads of linear algebra, a stop by a signal, and lack of memory."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

from threadpoolctl import threadpool_limits

from edp.storage.memory import free_bytes
from edp.wording import figure

VARIABLE = "OPENBLAS_NUM_THREADS"
_stopped_by: list[int] = []
"""Signals that asked this process to end."""
SHOWN_REASON = 200
"""Of what the library said, in a message."""


def use_one_blas_thread() -> None:
    """Use one thread in this process and its children, unless the environment names a number (see `training.blas`)."""
    if VARIABLE in os.environ:
        return
    # Children and libraries that are not loaded yet read the variable; NumPy has read it already.
    os.environ[VARIABLE] = "1"
    threadpool_limits(limits=1, user_api="blas")


def stop_on_request() -> None:
    """Take the system's request to end (SIGTERM) as Ctrl-C is taken: folders are let go of, helpers end, work stays."""
    signal.signal(signal.SIGTERM, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    _stopped_by.append(number)
    # As Ctrl-C: `finally` blocks run, locks are let go.
    raise KeyboardInterrupt


def exit_code_of_stop(usual: int) -> int:
    """Return the exit code of a stopped command: 128 plus the signal number, or `usual` after Ctrl-C."""
    return 128 + _stopped_by[-1] if _stopped_by else usual


def out_of_memory(error: BaseException) -> bool:
    """Return whether an error of Python, NumPy or PyTorch means that memory is exhausted."""
    message = str(error)
    named = isinstance(error, MemoryError) or any("OutOfMemory" in kind.__name__ for kind in type(error).__mro__)
    # PyTorch on the CPU raises a plain RuntimeError; only its text tells.
    return named or (isinstance(error, RuntimeError) and ("can't allocate memory" in message or "bad_alloc" in message))


ADVICE = {
    "train": "a smaller training.chunks.batch or length, a smaller network or window, or fewer recordings",
    "simulate": "fewer --workers, or more and shorter recordings",
    "screen": "fewer recordings or channels",
    "report": "fewer recordings judged, or a shorter data set",
    "search": "fewer --workers, or a cap --max-memory on each training",
}


def memory_message(error: BaseException) -> str:
    """Return a message on exhausted memory: the command, the free memory, and what to reduce."""
    command = next((word for word in sys.argv[1:] if word in ADVICE), "")
    doing = " ".join(sys.argv[1:2]) or "this command"
    reason = " ".join(str(error).split())[:SHOWN_REASON] or "an allocation failed"
    less = ADVICE.get(command, "fewer or shorter recordings, or a smaller network")
    return (
        f"edp {doing}: not enough memory ({reason}); {figure(free_bytes() / 1e9, 2)} GB are free now. Take {less}, or "
        "raise "
        "the limit of this process; what was finished is on disk"
    )
