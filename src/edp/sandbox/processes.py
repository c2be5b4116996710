"""Helper processes that end with their parent, even if the parent is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time

PR_SET_PDEATHSIG = 1
LOOK_S = 0.5
"""Time between checks of the parent process on systems that do not report its end."""


def die_with_parent(parent: int) -> None:
    """End this process when its parent ends: by the system on Linux, elsewhere by looking now and then.

    On Linux the thread that started this process counts as its parent.

    Args:
        parent: id of the parent process.
    """
    if sys.platform == "linux":
        # SIGKILL cannot be caught or ignored, whatever a library has installed.
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if os.getppid() != parent:  # it ended before that
        os._exit(1)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)
