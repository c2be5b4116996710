"""Helper processes that end with their parent, in whatever way it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import tempfile
import threading
import time
from multiprocessing import util

PR_SET_PDEATHSIG = 1
LONGEST_FOLDER = 60
"""Bytes of a folder for sockets: a Unix socket's path has 107 at most, of which `multiprocessing` adds some 40."""
SHORT_FOLDERS = ("/tmp", "/var/tmp", "/dev/shm")
LOOK_S = 0.5
"""Between checks of the parent, where the system does not tell of its end."""


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


def begin_helper(parent: int) -> None:
    """Initialise a pool process: it ends with its parent and leaves Ctrl-C to it.

    Args:
        parent: id of the parent process, which ends its helpers itself when it is interrupted.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(parent)


def choose_socket_folder() -> None:
    """Let `multiprocessing` put its sockets into a short folder where the folder of temporary files has a long path.

    Tensors travel between processes as file descriptors, through sockets with a path. The choice holds for this process
    and for those that it starts afterwards.
    """
    if len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER:
        return
    short = next((folder for folder in SHORT_FOLDERS if os.access(folder, os.W_OK | os.X_OK)), None)
    previous = tempfile.tempdir
    try:
        tempfile.tempdir = short
        util.get_temp_dir()  # made once a process, and removed at its end
    finally:
        tempfile.tempdir = previous
