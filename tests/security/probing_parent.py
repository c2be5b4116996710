"""A process that reads a hostile log whose reader runs native probes against it: prints what they reached, as JSON.

``python probing_parent.py FOLDER GROUP ...``; started by `without_layer.py` where a layer is to be missing.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import socket
import sys
import warnings
from dataclasses import asdict
from pathlib import Path

import hostile_format  # noqa: F401 - registers the format
from native_probes import Aims

from edp.errors import EdpError
from edp.logs import open_log
from edp.sandbox.layers import get_seen_layers
from edp.signals import SignalMap


def state(path: Path) -> list[object]:
    facts = path.stat()
    return [path.read_bytes().hex(), facts.st_mode, facts.st_mtime_ns, facts.st_uid, facts.st_nlink, os.listxattr(path)]


def own_state() -> list[object]:
    return [
        resource.getrlimit(resource.RLIMIT_NOFILE),
        os.getpriority(os.PRIO_PROCESS, 0),
        sorted(os.sched_getaffinity(0)),
        os.sched_getscheduler(0),
        os.getpgid(0),
        *heard,
    ]


heard: list[int] = []


def main(folder: Path, groups: list[str]) -> None:
    signal.signal(signal.SIGWINCH, lambda number, _: heard.append(number))
    (other := folder / "outside").write_text("secret")
    other.chmod(0o600)
    log = folder / "x.hostile"
    listener = socket.create_server(("127.0.0.1", 0))
    datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagrams.bind(("127.0.0.1", 0))
    abstract, named = (socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(2))
    name = f"edp_probe_{os.getpid()}"
    abstract.bind(f"\0{name}")
    # Relative: the path of a socket has at most 107 bytes.
    os.chdir(folder)
    named.bind("s")
    for server in (abstract, named):
        server.listen()
    aims = Aims(os.getpid(), str(other), str(log), listener.getsockname()[1], datagrams.getsockname()[1], name, "s")
    log.write_text("|".join(("probe", json.dumps({"aims": asdict(aims), "groups": groups}), "open")))
    before, files = own_state(), {path: state(path) for path in (other, log)}
    names = sorted(os.listdir(folder))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found, refused = dict(open_log(log, SignalMap()).meta), ""
        except EdpError as error:
            found, refused = {}, str(error)
    ready = select.select([listener, abstract, named, datagrams], [], [], 0)[0]
    changed = [str(path.name) for path, what in files.items() if state(path) != what]
    print(
        json.dumps(
            {
                "tried": len(found),
                "reached": {probe: what for probe, what in found.items() if what},
                "refused": refused,
                "warned": [str(each.message) for each in caught],
                "layers": get_seen_layers(),
                "files": changed + sorted(set(os.listdir(folder)) ^ set(names)),
                "process": [str(now) for was, now in zip(before, own_state()) if was != now] + heard,
                "connected": len(ready),
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
