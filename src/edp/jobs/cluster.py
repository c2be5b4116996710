"""Jobs on a Ray cluster: the only door to Ray. On every node a job runs through the pool of one machine.

Only the coordinator writes the ledger; a node needs this version of EDP and the recordings under the same path.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import tempfile
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edp.errors import ConfigError, LostError
from edp.jobs.base import (
    RETRIES,
    START,
    ClosedAtExit,
    Job,
    ended,
    refuse_twice,
)
from edp.jobs.processes import LocalPool
from edp.storage import write_bytes
from edp.storage.ledger import Record, TrainingStatus, code_version, state_path
from edp.storage.paths import is_there
from edp.storage.provenance import environment

NAMESPACE = "edp"
# An hour: nodes may be busy with a training before they answer.
HOUR_S = 3600.0
# Five seconds: Ray itself tries for minutes where nothing answers (docs/journal).
PROBE_S = 5.0
_pool: dict[int, LocalPool] = {}
"""Local pool of a Ray process, created once so that the worker stays warm between trainings."""


class RayPool(ClosedAtExit):
    """Runs jobs on the nodes of a Ray cluster; see `edp.jobs.base.Executor`.

    Caps on time and memory, and retries of a training whose process is killed, are those of `LocalPool`, which runs on
    the node; a training whose node or Ray worker is lost starts again elsewhere.

    Args:
        address: address of the cluster, for example ``10.0.0.1:6379``, or ``auto``.
        threads: number of threads and cores of each training.
        retries: maximum number of restarts of a training whose node or worker is lost.
        open_cluster: take a cluster without a token at an address that other computers may reach.

    Raises:
        ConfigError: Ray is missing, the cluster cannot be reached or is open, or a node has other code or versions.
    """

    def __init__(self, address: str, threads: int = 1, retries: int = RETRIES, open_cluster: bool = False) -> None:
        if not open_cluster:
            check_closed(address)
        self.ray = _ray()
        self.threads, self.retries = threads, retries
        _reach(self.ray, address)
        self._function = self.ray.remote(num_cpus=threads, max_retries=retries)(_perform_there)
        self._jobs: dict[str, Job] = {}
        self._refs: dict[Any, str] = {}
        self._ready: deque[Record] = deque()
        try:
            self._check_nodes()
        # Half a connection must not stay open: Ray allows one a process.
        except BaseException:
            self.close()
            raise

    @property
    def workers(self) -> int:
        """How many trainings the cores of the cluster hold side by side now."""
        return max(1, int(self.ray.cluster_resources().get("CPU", 1.0)) // self.threads)

    def submit(self, job: Job) -> None:
        """Take a job; see `Executor.submit`."""
        refuse_twice(job, self._jobs)
        self._jobs[job.key] = job
        # The ledger may not be reachable from a node, and only the coordinator writes it: states travel with the job.
        where = dict(job.where)
        file = Path(where.pop(START)) if START in where else None
        start = None if file is None else _StateFile(file.name, file.read_bytes())
        sent = replace(job, folder=None, where=where)
        reference = self._function.options(name=job.key).remote(sent, self.threads, start)
        self._refs[reference] = job.key

    def running(self) -> list[str]:
        """Return the keys of the jobs in the cluster, at most as many as its capacity."""
        return list(self._refs.values())[: self.workers]

    def wait_any(self, timeout_s: float | None = None) -> Record | None:
        """Return the next finished training; see `Executor.wait_any`."""
        if not self._ready:
            if not self._refs:
                return None
            done, _ = self.ray.wait(list(self._refs), num_returns=1, timeout=timeout_s)
            if not done:
                return None
            self._hear(done[0])
        record = self._ready.popleft()
        del self._jobs[record.key]
        return record

    def cancel(self, key: str) -> None:
        """Stop a job; see `Executor.cancel`."""
        if self._jobs.pop(key, None) is None:
            return
        self._ready = deque(record for record in self._ready if record.key != key)
        for reference in [one for one, job_key in self._refs.items() if job_key == key]:
            del self._refs[reference]
            with contextlib.suppress(Exception):  # a node that is gone has nothing to cancel
                self.ray.cancel(reference, force=True)

    def close(self) -> None:
        """Stop all jobs and leave the cluster, which continues to run."""
        for key in list(self._jobs):
            self.cancel(key)
        self.ray.shutdown()

    def _hear(self, reference: Any) -> None:
        job = self._jobs[self._refs.pop(reference)]
        errors = self.ray.exceptions
        try:
            data, state = self.ray.get(reference)
            record = Record.from_bytes(data)
            if state is not None and job.folder is not None:
                # The state goes in before the record, which says that it is there.
                write_bytes(state_path(job.folder, job.key), state)
        except errors.OutOfMemoryError as error:
            record = ended(job, TrainingStatus.OOM, f"the node was out of memory: {_line(error)}")
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.ObjectLostError) as error:
            record = ended(
                job, TrainingStatus.LOST, f"its node or worker was lost {self.retries + 1} times: {_line(error)}"
            )
        except errors.RaySystemError as error:
            raise LostError(
                f"the cluster does not answer any more: {_line(error)}. What is done is kept; start the cluster again "
                "and give the same command"
            ) from error
        self._ready.append(record)

    def _check_nodes(self) -> None:
        """Check that every node has this code and these versions, since the key of each record states them."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        asked = {}
        for node in self.ray.nodes():
            if node["Alive"] and node["Resources"].get("CPU", 0.0) >= self.threads:
                # Hard affinity: another node's answer would prove nothing about this one.
                strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                remote = self.ray.remote(num_cpus=self.threads, scheduling_strategy=strategy)(_state_there)
                asked[f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"] = remote.remote(self.threads)
        if not asked:
            raise ConfigError(f"the cluster has no node with {self.threads} free cores; add one, or take fewer threads")
        here, errors, answered = _state_there(self.threads), self.ray.exceptions, 0
        for name, reference in asked.items():
            try:
                there = self.ray.get(reference, timeout=HOUR_S)
            # A whole hour, since the task may wait behind trainings.
            except (errors.TaskUnschedulableError, errors.NodeDiedError):
                continue  # it was killed a moment ago, and the cluster had not noticed; nothing will run there
            except errors.RayError as error:
                raise ConfigError(
                    f"node {name} cannot run EDP: {_line(error)}; install the same version of it there"
                ) from error
            answered += 1
            other = sorted(part for part in here if here[part] != there.get(part))
            if other:
                differences = ", ".join(f"{part} {there.get(part)} (here {here[part]})" for part in other)
                raise ConfigError(f"node {name} has other code or versions: {differences}; install the same there")
        if not answered:
            raise ConfigError("no node of the cluster answers; start one, then give the same command again")


@dataclass(frozen=True)
class _StateFile:
    """File with the state from which a training continues."""

    name: str
    content: bytes


def _perform_there(job: Job, threads: int, start: _StateFile | None) -> tuple[bytes, bytes | None]:
    """Run a training in a Ray process on some node, through a pool of one whose process is reused.

    Args:
        job: training to run.
        threads: number of threads of the training.
        start: the state that it goes on from.

    Returns:
        The record, and the file of the state that it left, both as they are in a ledger.
    """
    pool = _pool.get(threads)
    if pool is None:
        # One pool for each number of threads: workers keep theirs for life.
        pool = _pool[threads] = LocalPool(1, threads)
    with tempfile.TemporaryDirectory(prefix="edp-training-") as folder:  # stands for the ledger
        where = dict(job.where)
        if start is not None:
            file = Path(folder, start.name)
            write_bytes(file, start.content)
            where[START] = str(file)
        pool.submit(replace(job, folder=folder, where=where))
        try:
            record = pool.wait_any()
        finally:
            # Whatever happened, the process must not go on with a training that nobody waits for.
            pool.cancel(job.key)
        if record is None:
            raise RuntimeError("the pool of a node gave a training up without a word")
        left = state_path(folder, job.key)
        return record.to_bytes(), left.read_bytes() if is_there(left) else None


def _state_there(threads: int) -> dict[str, str]:
    # All of the code: a unit of work may call any part of it.
    return {"code": code_version(whole=True), **environment(threads)}


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise ConfigError(
            "a cluster needs Ray, which is not installed; pip install 'excavator-dynamics-predictor[cluster]' here and "
            "on every node, or take --workers"
        ) from error
    return ray


def check_closed(address: str) -> None:
    """Refuse a cluster at which anybody in the network may run code.

    Ray listens on all interfaces and, without a token, runs what any client sends. A cluster that checks tokens turns
    away a client without one, so a client that is set up without a token can only ever reach an open cluster.

    Args:
        address: address of the cluster; ``auto`` may lead to any cluster.

    Raises:
        ConfigError: the address is not loopback, and Ray's token authentication is off here.
    """
    if _is_loopback(address.rpartition(":")[0] or address) or os.environ.get("RAY_AUTH_MODE", "").lower() == "token":
        return
    raise ConfigError(
        f"the cluster at '{address}' is used without a token: whoever reaches it can run code on its nodes. Start its "
        "nodes with RAY_AUTH_MODE=token and RAY_AUTH_TOKEN, and set both here; or give --open-cluster where nobody "
        "else is in that network"
    )


def _is_loopback(host: str) -> bool:
    try:
        # A host name is no loopback by its looks; only addresses and `localhost` pass.
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _reach(ray: Any, address: str) -> None:
    advice = (
        "Start one (ray start --head; ray start --address=HOST:PORT on the other nodes) and give its address; where it "
        "asks for a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN here, too"
    )
    host, _, port = address.rpartition(":")
    if host and port.isdigit():  # Ray itself tries for minutes
        try:
            socket.create_connection((host, int(port)), PROBE_S).close()
        except OSError as error:
            raise ConfigError(f"nothing answers at '{address}': {_line(error)}. {advice}") from error
    try:
        ray.init(address=address, namespace=NAMESPACE, log_to_driver=False, configure_logging=False)
    except Exception as error:  # Ray raises a dozen kinds, from ConnectionError to plain RuntimeError
        raise ConfigError(f"there is no Ray cluster at '{address}': {_line(error)}. {advice}") from error


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text[:300] + ("..." if len(text) > 300 else "")
