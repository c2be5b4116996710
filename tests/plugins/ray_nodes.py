"""A real Ray cluster of three nodes on this machine, of which some can be killed; needs the extra `cluster`."""

import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

TOKEN = secrets.token_hex(16)
RAY = Path(sys.executable).with_name("ray")
needs_ray = pytest.mark.skipif(not RAY.exists(), reason="the extra 'cluster' (Ray) is not installed")
START_S = 300


class Nodes:
    """Nodes of a cluster, a process group each."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self.groups = []

    def start(self, *options):
        command = [
            RAY,
            "start",
            *options,
            "--node-ip-address=127.0.0.1",
            "--num-cpus=1",
            "--object-store-memory=80000000",
            "--block",
        ]
        with (self.folder / f"node{len(self.groups)}.log").open("wb") as log:
            node = subprocess.Popen(
                [*command, "--disable-usage-stats"], stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        self.groups.append(node)

    def join(self, size):
        """One more node, and wait until the cluster has so many; a connection of Ray must be open."""
        import ray

        self.start(f"--address={self.address}")
        until = time.monotonic() + START_S
        while ray.cluster_resources().get("CPU", 0) < size and time.monotonic() < until:
            time.sleep(0.5)

    def kill(self, number):
        """kill -9 of a whole node, as when its plug is pulled."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.groups[number].pid, signal.SIGKILL)
        self.groups[number].wait()


@contextlib.contextmanager
def three_nodes(patch, modules):
    """A cluster with a token; `modules` is a folder that its workers import from, too."""
    patch.setenv("RAY_AUTH_MODE", "token")  # before Ray is imported, which reads them once
    patch.setenv("RAY_AUTH_TOKEN", TOKEN)
    patch.setenv("PYTHONPATH", os.pathsep.join([str(modules), *filter(None, sys.path)]))
    import ray

    folder = Path(tempfile.mkdtemp(prefix="edp-ray-"))  # not the test's own: paths of sockets must be short
    nodes = Nodes(folder)
    try:
        nodes.start("--head", f"--port={nodes.port}", "--include-dashboard=false", f"--temp-dir={folder / 'head'}")
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", nodes.port), 1):
                break
            time.sleep(0.2)
        ray.init(address=nodes.address, log_to_driver=False)
        for size in (2, 3):  # one after the other: two that start at once may take the same ports
            nodes.join(size)
        ray.shutdown()
        yield nodes
    finally:
        ray.shutdown()
        for number in reversed(range(len(nodes.groups))):
            nodes.kill(number)
        shutil.rmtree(folder, ignore_errors=True)
