"""A file format whose reader does what the file says: stands for a library that a hostile file has taken over.

The sandbox's worker imports this module as it imports any registered format's.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import native_probes
import numpy as np

from edp.logs.formats.base import FORMATS, RawLog, RawSignal
from edp.sandbox import lockdown
from edp.storage import memory as limits


def _connect(_: str) -> None:
    socket.create_connection(("127.0.0.1", 9), timeout=1)


def _c_call(name: str, *arguments: object) -> None:
    """A call of the C library, which Python's audit hook does not see."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{name}: {os.strerror(number)}")


def _allocate(megabytes: str) -> None:
    kept = [np.ones(1 << 20, dtype=np.uint8) for _ in range(int(megabytes))]
    raise ValueError(f"{len(kept)} MB were had")


def _announced(megabytes: str) -> None:
    limits.announce(memory=int(megabytes) << 20)
    _allocate(megabytes)


def handles() -> dict[str, str]:
    """What each open handle of this process leads to."""
    found = {}
    for number in os.listdir("/proc/self/fd"):
        try:
            found[number] = os.readlink(f"/proc/self/fd/{number}")
        except OSError:  # that of the listing itself
            continue
    return found


def _threads(_: str) -> None:
    done = []
    threads = [threading.Thread(target=done.append, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    raise ValueError(f"{len(done)} threads ran")


def _layers(_: str) -> None:
    raise ValueError(" and ".join(name for name, missing in LAYERS.items() if not missing))


DEEDS = {
    "socket": _connect,
    "socket in C": lambda _: _c_call("socket", 2, 1, 0),
    "program": lambda path: subprocess.run([sys.executable, "-c", f"open({path!r}, 'w')"], check=True),
    "system": lambda path: os.system(f"touch {path}"),
    "program in C": lambda path: _c_call("execv", sys.executable.encode(), None),
    "fork": lambda _: os.fork(),
    "fork in C": lambda _: _c_call("fork"),
    "read": lambda path: Path(path).read_bytes(),
    "read in C": lambda path: _c_call("open", path.encode(), os.O_RDONLY),
    "write": lambda path: Path(path).write_bytes(b"x"),
    "write in C": lambda path: _c_call("open", path.encode(), os.O_WRONLY | os.O_CREAT, 0o600),
    "remove": lambda path: Path(path).unlink(),
    "remove in C": lambda path: _c_call("unlink", path.encode()),
    "mode in C": lambda path: _c_call("chmod", path.encode(), 0o777),
    "signal": lambda pid: os.kill(int(pid), signal.SIGTERM),
    "signal in C": lambda pid: _c_call("kill", int(pid), 0),
    "trace in C": lambda pid: _c_call("ptrace", 16, int(pid), None, None),
    "unpickle": lambda _: __import__("pickle").loads(b"cos\nsystem\n."),
    "allocate": _allocate,
    "announce": _announced,
    "loop": lambda _: [None for _ in iter(int, 1)],
    "wait": lambda _: threading.Event().wait(),
    "crash": lambda number: signal.raise_signal(int(number)),
    "exit": lambda number: os._exit(int(number)),
    "threads": _threads,
    "layers": _layers,
    "fail": lambda text: (_ for _ in ()).throw(KeyError(text)),
    "recursion": lambda text: _deep(text),
}
LAYERS: dict[str, str] = {}
_lock_down = lockdown.lock_down


def _deep(text: str) -> None:
    _deep(text)


def _note(*arguments: object) -> dict[str, str]:
    LAYERS.update(_lock_down(*arguments))
    return LAYERS


class HostileFormat:
    """``DEED|ARGUMENT|WHEN`` in a file; it is done when the file is opened, or when a column is."""

    name = "hostile"
    suffixes = (".hostile",)
    content = "a hostile file"

    def claims(self, head):
        return True

    def read(self, path, signal_map):
        deed, argument, when = path.read_text().split("|")
        if when == "open" and deed in DEEDS:
            DEEDS[deed](argument)

        def load():
            if when == "load":
                DEEDS[deed](argument)
            return np.full(9, float(os.getpid()))

        meta = {}
        if deed == "probe":
            order = json.loads(argument)
            meta = native_probes.run(native_probes.Aims(**order["aims"]), tuple(order["groups"]))
        if deed == "look":
            variables = Path("/proc/self/environ").read_text()
            meta = {"environment": dict(os.environ), "handles": handles(), "proc": variables}
        return RawLog(path, {"BmUp": RawSignal("BmUp", load, 9)}, rate_hz=100.0, meta=meta)

    def write(self, recording, path, options):
        raise NotImplementedError


PART = HostileFormat()
FORMATS.register("hostile")(PART)
if os.environ.get("EDP_TEST_START_S"):
    from edp.sandbox import allowance

    allowance.START_S = float(os.environ["EDP_TEST_START_S"])
import edp.logs.served  # noqa: E402 - its lock_down is the one that is called

edp.logs.served.lock_down = _note
