"""The local pool: typed ends, caps, and workers that are killed."""

import os
import signal
import threading
import time

import pytest

from edp.errors import ConfigError, StorageError
from edp.jobs import perform as performing
from edp.jobs.base import complete
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger, TrainingStatus, claim, leave_arrival

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def pool():
    """One pool for all tests that leave its workers alive."""
    with LocalPool(2) as made:
        yield made


def collect(pool, jobs):
    for job in jobs:
        pool.submit(job)
    return {record.identity.seed: record for record in iter(pool.wait_any, None)}


def until(ready):
    deadline = time.monotonic() + 240
    while not ready():
        assert time.monotonic() < deadline, "nothing happened for four minutes"
        time.sleep(0.01)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_jobs_come_back_with_result_and_measures(pool, job_of, log):
    found = collect(pool, [job_of(seed) for seed in range(5)])
    assert sorted(found) == list(range(5))
    assert all(record.status is TrainingStatus.DONE for record in found.values())
    assert {seed: record.result["score"] for seed, record in found.items()} == {s: 1 / (1 + s) for s in range(5)}
    assert found[0].result["threads"] == "1"
    assert {"seconds", "peak_mb", "host", "attempts", "finished"} <= set(found[0].measured)
    assert log("start") == log("end") == 5
    assert len(pool.processes()) <= 2
    assert pool.wait_any() is None


@pytest.mark.parametrize(
    ("how", "status", "message"),
    [
        ("error", TrainingStatus.FAILED, "ValueError: no such optimiser"),
        ("user", TrainingStatus.FAILED, "give at least 1 epoch"),
        ("exit", TrainingStatus.FAILED, "SystemExit: 3"),
        ("list", TrainingStatus.FAILED, "returned list"),
        ("diverged", TrainingStatus.DIVERGED, "the loss is nan in epoch 3"),
        ("nan", TrainingStatus.DIVERGED, "'score' is nan"),
        ("inf", TrainingStatus.DIVERGED, r"'scores\[1\]' is -inf"),
        ("memory", TrainingStatus.OOM, "MemoryError: 512 GB"),
    ],
)
def test_how_a_training_ends_is_typed_and_not_tried_again(pool, job_of, log, tmp_path, how, status, message):
    with Ledger(tmp_path / "study") as ledger:
        for _ in range(2):
            (record,) = complete(ledger, pool, [job_of(7, "raises", how=how)]).values()
            assert record.status is status
            assert record.message.startswith(message) or message.replace("\\", "") in record.message
            assert record.result is None
            assert record.measured["attempts"] == 1
        assert ("Traceback" in record.measured.get("trace", "")) == (how in ("error", "exit", "memory"))
    assert log("start") == 1


def test_a_job_that_does_not_exist(pool, job_of):
    found = collect(pool, [job_of(1, "nothing")])
    assert found[1].status is TrainingStatus.FAILED
    assert "there is no job 'trainings_of_tests:nothing'" in found[1].message


def test_an_equal_job_is_refused_while_one_is_under_way(pool, job_of):
    pool.submit(job_of(1))
    with pytest.raises(ConfigError, match="submitted twice"):
        pool.submit(job_of(1))
    assert pool.wait_any().status is TrainingStatus.DONE
    pool.submit(job_of(1))
    assert pool.wait_any().status is TrainingStatus.DONE


def test_waiting_has_an_end(pool, job_of):
    pool.submit(job_of(1, sleep=0.5))
    assert pool.wait_any(0.05) is None
    assert pool.running() == [job_of(1, sleep=0.5).key]
    assert pool.wait_any().status is TrainingStatus.DONE


def test_a_killed_worker_is_replaced_and_only_its_training_starts_again(job_of, log):
    with LocalPool(2) as pool:
        found = collect(pool, [job_of(0, "killed", times=2), *(job_of(seed) for seed in range(1, 5))])
        assert all(record.status is TrainingStatus.DONE for record in found.values())
        assert [found[seed].measured["attempts"] for seed in range(5)] == [3, 1, 1, 1, 1]
        assert log("start 0") == 3
        assert log("end") == 4
        for pid in pool.processes():  # idle ones, too, are replaced, at no cost to a training
            os.kill(pid, signal.SIGKILL)
        found = collect(pool, [job_of(seed) for seed in range(5, 8)])
        assert [record.status for record in found.values()] == [TrainingStatus.DONE] * 3


def test_killed_three_times_is_lost_and_tried_again_by_the_next_search(job_of, log, tmp_path):
    jobs = [job_of(0, "killed", times=3), job_of(1)]
    with LocalPool(1) as pool, Ledger(tmp_path / "study") as ledger:
        lost, done = complete(ledger, pool, jobs).values()
        assert lost.status is TrainingStatus.LOST
        assert "its process ended 3 times, last by signal 9: last words" in lost.message
        assert done.status is TrainingStatus.DONE
        assert log("start 0") == 3
        again, _ = complete(ledger, pool, jobs).values()
        assert again.status is TrainingStatus.DONE
        assert log("start 1") == 1


def test_time_and_memory_over_the_cap(job_of, log):
    with LocalPool(2) as pool:
        pool.submit(job_of(0, seconds=0.3, sleep=30.0))
        pool.submit(job_of(1, "hog", memory_mb=120, mb=400))
        found = {record.identity.seed: record for record in iter(pool.wait_any, None)}
        assert found[0].status is TrainingStatus.TIMEOUT
        assert found[0].message == "it took longer than 0.3 s"
        assert found[1].status is TrainingStatus.OOM
        assert found[1].message == "it took more than 120 MB of memory"
        assert log("start") == 2
        assert pool.processes() == []
        assert collect(pool, [job_of(3)])[3].status is TrainingStatus.DONE


def test_a_process_that_did_other_trainings_does_not_decide_on_memory(job_of, log):
    with LocalPool(1) as pool:
        collect(pool, [job_of(0)])
        found = collect(pool, [job_of(1, "hog", memory_mb=120, mb=400)])
        assert found[1].status is TrainingStatus.OOM
        assert log("start 1") == 2
        assert found[1].measured["attempts"] == 1


def test_cancelled_jobs_say_nothing(job_of, log):
    with LocalPool(1) as pool:
        jobs = [job_of(seed, sleep=60.0) for seed in range(2)] + [job_of(2)]
        for job in jobs:
            pool.submit(job)
        until(lambda: log("start 0"))
        (pid,) = pool.processes()
        pool.cancel(jobs[1].key)
        pool.cancel(jobs[0].key)
        pool.cancel("unknown")
        assert not alive(pid)
        assert pool.wait_any().identity.seed == 2
        assert pool.wait_any() is None
        assert log("start") == 2


def test_closing_leaves_no_process(job_of, log):
    with LocalPool(2) as pool:
        for seed in range(4):
            pool.submit(job_of(seed, sleep=60.0))
        until(lambda: log("start") == 2)
        pids = pool.processes()
        assert len(pids) == 2
    assert not any(alive(pid) for pid in pids)


def test_a_pool_is_used_from_one_thread(pool, job_of):
    errors = []

    def other():
        try:
            pool.submit(job_of(0))
        except RuntimeError as error:
            errors.append(str(error))

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert "from the thread that made it" in errors[0]
    pool.cancel(job_of(0).key)


def test_a_training_that_someone_else_does_is_not_done_twice(pool, job_of, log, tmp_path, monkeypatch):
    job = job_of(0)
    monkeypatch.setattr(performing, "CLAIM_WAIT_S", 0.2)
    with claim(tmp_path, job.key):
        record = performing.perform(job.identity, job.where, str(tmp_path), lambda: None)
    assert record.status is TrainingStatus.LOST
    assert f"claimed by process {os.getpid()}" in record.message
    assert log("start") == 0
    first = performing.perform(job.identity, job.where, str(tmp_path), lambda: None)
    assert first.status is TrainingStatus.DONE
    assert performing.perform(job.identity, job.where, str(tmp_path), lambda: None) == first
    assert log("start") == 1


def test_a_full_disk_stops_the_search_and_it_goes_on(pool, job_of, log, tmp_path, monkeypatch):
    jobs = [job_of(0), job_of(1), job_of(2, sleep=1.0)]

    def full(self, record):
        if len(self) == 1:
            raise StorageError("cannot write: No space left on device")
        return put(self, record)

    put = Ledger.put
    with Ledger(tmp_path / "study") as ledger:
        with monkeypatch.context() as patch:
            patch.setattr(Ledger, "put", full)
            with pytest.raises(StorageError, match="No space left"):
                complete(ledger, pool, jobs)
        assert len(ledger) == 1
        assert pool.running() == []
    with Ledger(tmp_path / "study") as ledger:
        told = []
        found = complete(ledger, pool, jobs, lambda record, trained: told.append(trained))
        assert [record.status for record in found.values()] == [TrainingStatus.DONE] * 3
        assert list(found) == [job.key for job in jobs]
        assert log("end") == 3
        assert set(told) <= {True, False}


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"workers": 1, "threads": 0}])
def test_a_pool_of_nothing(wrong):
    with pytest.raises(ConfigError, match="cannot do anything"):
        LocalPool(**wrong)


def test_memory_caps_are_refused_where_they_cannot_be_held(pool, job_of, monkeypatch):
    monkeypatch.setattr("edp.jobs.processes.sys.platform", "darwin")
    with pytest.raises(ConfigError, match="needs Linux"):
        pool.submit(job_of(0, memory_mb=1))


def test_leavings_of_a_killed_coordinator_are_not_trained_again(pool, job_of, log, tmp_path):
    job = job_of(0)
    (record,) = collect(pool, [job]).values()
    leave_arrival(tmp_path / "study", record)
    with Ledger(tmp_path / "study") as ledger:
        complete(ledger, pool, [job])
    assert log("start") == 1
