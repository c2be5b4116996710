"""Process that runs the jobs of a pool: ``python -m edp.jobs.worker`` with a socket. Not for direct use.

The process ends with its parent and returns one record for each job.

It lives as long as its parent and not longer, and answers each job with one record.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any

from edp.jobs.perform import BEGUN, perform
from edp.sandbox.processes import die_with_parent


def serve(connection: Connection) -> None:
    """Do jobs until the other side closes."""
    jobs: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                jobs.put(pickle.loads(connection.recv_bytes()))
        os._exit(1)  # in the middle of a training, too: nobody waits for it

    threading.Thread(target=listen, daemon=True).start()
    while True:
        identity, where, folder = jobs.get()
        record = perform(identity, where, folder, lambda: connection.send_bytes(BEGUN))
        connection.send_bytes(record.to_bytes())


if __name__ == "__main__":
    # Children of the training must not inherit the socket, or the pool would wait for them.
    os.set_inheritable(int(sys.argv[1]), False)
    die_with_parent(int(sys.argv[2]))
    serve(Connection(int(sys.argv[1])))
