"""A real Ray cluster of three nodes on this machine: the same study, the same result, with a node killed meanwhile."""

import dataclasses
import os
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from noted_progress import NotedProgress
from ray_nodes import needs_ray, three_nodes

import edp.jobs.cluster
from edp.errors import ConfigError
from edp.jobs.base import START, complete
from edp.jobs.cluster import RayPool
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger, TrainingStatus, read_state
from edp.workflows.search.plan import load_plan
from edp.workflows.search.runner import Resources, run_search

pytestmark = pytest.mark.processes

CHANGES = (
    'task={targets=["speed"], horizons=[1]}',
    'model={backbone={kind="lstm", units=4}, window=5, head={hidden=4}}',
    "training.chunks={length=20, batch=4, burn_in=5}",
    'search={horizon=1, backbones=["lstm"], features=["all"], updates=3, final_updates=4, folds=2, isolation={runs=4}}',
    "search={isolation={seeds=2}, calibration={trials=3}}",
    "search.space={units=[2, 4], kernel=false}",
)


@pytest.fixture
def cluster(monkeypatch):
    with three_nodes(monkeypatch, Path(__file__).parent) as nodes:
        yield nodes


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_on_three_nodes_of_which_one_is_killed_finds_what_one_machine_finds(cluster, six_sessions, tmp_path):
    plan = load_plan(None, "quick", CHANGES)
    done = []

    def kill_one(count, trained, workers, **values):
        if trained == 4 and not done:
            done.append(workers)
            cluster.kill(2)

    resources = Resources(cluster=cluster.address)
    there = run_search(six_sessions, plan, tmp_path / "there", resources, "calibration", NotedProgress(kill_one))
    assert done == [3]
    here = run_search(six_sessions, plan, tmp_path / "here", Resources(count=1), "calibration")
    assert there.digest == here.digest
    assert there.trained == here.trained == 11
    assert there.context.decided == here.context.decided
    again = run_search(six_sessions, plan, tmp_path / "there", resources, "calibration")
    assert again.trained == 0


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_caps_failures_and_cancelling_are_those_of_the_local_pool(cluster, job_of, tmp_path):
    jobs = [job_of(0), job_of(1, "raises", how="error"), job_of(2, seconds=1.0, sleep=60)]
    with RayPool(cluster.address) as pool, Ledger(tmp_path / "ledger") as ledger:
        found = [str(record.status) for record in complete(ledger, pool, jobs).values()]
        assert found == [TrainingStatus.DONE, TrainingStatus.FAILED, TrainingStatus.TIMEOUT]
        pool.submit(job_of(3, sleep=600))
        with pytest.raises(ConfigError, match="submitted twice"):
            pool.submit(job_of(3, sleep=600))
        pool.cancel(job_of(3, sleep=600).key)
        assert pool.wait_any(0.1) is None
        pool.submit(job_of(4))
        assert pool.wait_any().status is TrainingStatus.DONE  # the cancelled one holds no core


@needs_ray
def test_no_cluster_at_an_address_is_told_at_once():
    with pytest.raises(ConfigError, match=r"nothing answers at '127\.0\.0\.1:9'.*ray start --head"):
        Resources(cluster="127.0.0.1:9").open()


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"\[cluster\]"):
        Resources(cluster="auto", open_cluster=True).open()


def test_workers_of_two_kinds_are_refused():
    with pytest.raises(ConfigError, match="expected one of the two"):
        Resources(cluster="auto", count=2)
    assert isinstance(Resources(count=1).open(), LocalPool)


class OneNode:
    """Stands for Ray: does what is sent on the spot, and only what was pickled arrives."""

    exceptions = SimpleNamespace(
        **{name: type(name, (Exception,), {}) for name in ("OutOfMemoryError", "WorkerCrashedError", "NodeDiedError")},
        **{name: type(name, (Exception,), {}) for name in ("ObjectLostError", "RaySystemError")},
    )

    def __init__(self):
        self.sent, self.results = [], {}

    def remote(self, **_):
        def send(function, *arguments):
            self.sent.append(pickle.dumps(arguments))
            self.results[len(self.sent)] = function(*pickle.loads(self.sent[-1]))
            return len(self.sent)

        def wrap(function):
            call = SimpleNamespace(remote=lambda *arguments: send(function, *arguments))
            return SimpleNamespace(options=lambda name: call)

        return wrap

    def wait(self, references, num_returns, timeout):
        return references[:num_returns], references[num_returns:]

    def get(self, reference):
        return self.results.pop(reference)

    def cancel(self, reference, force):
        self.results.pop(reference, None)

    def shutdown(self):
        for pool in edp.jobs.cluster._pool.values():
            pool.close()
        edp.jobs.cluster._pool.clear()


@pytest.fixture
def node(monkeypatch):
    one = OneNode()
    monkeypatch.setattr(edp.jobs.cluster, "_ray", lambda: one)
    monkeypatch.setattr(edp.jobs.cluster, "_reach", lambda ray, address: None)
    monkeypatch.setattr(RayPool, "_check_nodes", lambda self: None)
    return one


def test_states_travel_with_jobs_and_nodes_never_see_the_ledger(node, job_of, tmp_path):
    folder = tmp_path / "ledger"
    with RayPool("somewhere", open_cluster=True) as pool, Ledger(folder) as ledger:
        first = job_of(1, "goes_on")
        complete(ledger, pool, [first])
        file = ledger.state(first.key)
        assert read_state(file) == b" 1"
        second = job_of(2, "goes_on")
        begun = dataclasses.replace(second, where={**second.where, START: str(file)})
        assert complete(ledger, pool, [begun])[second.key].result == {"before": " 1"}
        assert read_state(ledger.state(second.key)) == b" 1 2"
        assert list((folder / "arrived").iterdir()) == []
    assert not any(os.fsencode(folder) in sent for sent in node.sent)


def test_a_state_that_breaks_on_its_way_to_a_node_is_not_gone_on_from(node, job_of, tmp_path):
    with RayPool("somewhere", open_cluster=True) as pool, Ledger(tmp_path / "ledger") as ledger:
        broken = tmp_path / "0.state"
        broken.write_bytes(b"edp state 1")
        job = job_of(3, "tells_of_a_state")
        found = complete(ledger, pool, [dataclasses.replace(job, where={**job.where, START: str(broken)})])
        assert found[job.key].result == {"whole": False}
        assert ledger.state(job.key) is None
