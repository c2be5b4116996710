"""Rungs with real trainings: stops between them, damaged or lost states, a full disk, killed workers."""

import dataclasses
import errno
import os
import signal
import time

import pytest
from noted_progress import NotedProgress

import edp.storage
from edp.config.experiment import load_experiment
from edp.errors import LostError, StorageError
from edp.evaluation.study import read_study
from edp.jobs.perform import perform
from edp.jobs.processes import LocalPool
from edp.report import write_study_page
from edp.storage.ledger import (
    Ledger,
    Record,
    TrainingStatus,
    WithState,
    leave_arrival,
    leave_state,
    read_state,
    state_path,
)
from edp.workflows.search.arms import Arm
from edp.workflows.search.engine import Dispatcher
from edp.workflows.search.export import export_study
from edp.workflows.search.jobs import job_of as job_of_order
from edp.workflows.search.plan import load_plan
from edp.workflows.search.runner import Resources, run_search
from edp.workflows.search.study_log import look_at
from edp.workflows.search.trainings import TrainingRequest

TINY = (
    'task={targets=["speed"], horizons=[1]}',
    'model={backbone={kind="lstm", units=4, dropout=0.1}, window=5, blocks=[], head={hidden=4}}',
    "training.chunks={length=20, batch=4, burn_in=5}",
)
CHANGES = (
    *TINY,
    'search={horizon=1, backbones=["lstm"], features=["all"], updates=8, final_updates=9, folds=2, isolation={runs=4}}',
    'search={isolation={seeds=2}, calibration={trials=16}, rungs=[0.25, 0.5], pruner="median"}',
    'search.sampler={kind="random"}',
    "search.space={units=[2, 4], layers=false, kernel=false, learning_rate={low=1e-4, high=1.0, log=true}}",
)


class Inline:
    """Does jobs in this process, as a worker would; `heard` are the keys and whether each went on from a state."""

    workers = 1

    def __init__(self):
        self.queue, self.heard = [], []

    def submit(self, job):
        self.queue.append(job)

    def wait_any(self, timeout_s=None):
        job = self.queue.pop(0)
        self.heard.append((job.key, "start" in job.where))
        return perform(job.identity, job.where, job.folder, lambda: None)

    def cancel(self, key):
        self.queue = [job for job in self.queue if job.key != key]

    def running(self):
        return []

    def close(self):
        self.queue.clear()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


class Here(Resources):
    def open(self):
        return Inline()


class Stop(Exception):
    """Stands for Ctrl-C."""


CREW = Here(count=1)


@pytest.fixture(scope="module")
def order(lever_sessions):
    settings = Arm.from_experiment(load_experiment(None, "quick", [*TINY, 'task.features="all"'])).tables
    return TrainingRequest(settings, lever_sessions.to_dict(), ("s0", "s1", "s2"), ("s3", "s4"), seed=1, updates=12)


def parts_of(order, stops=(3, 6)):
    return [
        dataclasses.replace(order, until=until, stops=tuple(stops[:number]))
        for number, until in enumerate([*stops, None])
    ]


def test_a_training_over_rungs_is_the_training_without_them(order, tmp_path):
    first, second, last = parts_of(order)
    assert job_of_order(last, "d").key == job_of_order(order, "d").key
    assert len({job_of_order(one, "d").key for one in (first, second, last)}) == 3
    assert job_of_order(second, "d").key == job_of_order(dataclasses.replace(second, stops=()), "d").key
    executor = Inline()
    with Ledger(tmp_path / "rungs") as ledger:
        do = Dispatcher(ledger, executor, "d")
        judged = [do([part])[0] for part in (first, second)]
        assert len(os.listdir(tmp_path / "rungs/states")) == 1  # that of the second, the first being of no use any more
        over_rungs = do([last])[0]
        assert os.listdir(tmp_path / "rungs/states") == []
    assert [begun for _, begun in executor.heard] == [False, True, True]
    with Ledger(tmp_path / "whole") as ledger:
        whole = Dispatcher(ledger, Inline(), "d")([order])[0]
    assert over_rungs.result == whole.result
    assert judged[0].result["scores"] != judged[1].result["scores"]


@pytest.mark.parametrize("harm", ["gone", "cut", "changed", "of another"])
def test_a_state_that_is_damaged_is_set_apart_and_the_rung_before_it_serves(harm, order, tmp_path):
    first, second, last = parts_of(order)
    executor = Inline()
    with Ledger(tmp_path) as ledger:
        do = Dispatcher(ledger, executor, "d")
        do([first, dataclasses.replace(first, seed=2)])
        do.ledger.keep_states = lambda keys: None  # both rungs keep theirs
        do([second])
        file = ledger.state(job_of_order(second, "d").key)
        data = file.read_bytes()
        if harm == "gone":
            file.unlink()
        elif harm == "of another":
            file.write_bytes(ledger.state(job_of_order(dataclasses.replace(first, seed=2), "d").key).read_bytes())
        else:
            file.write_bytes(data[:-1] if harm == "cut" else data[:-1] + bytes([data[-1] ^ 1]))
        harmed = do([last])[0]
    assert executor.heard[-1] == (job_of_order(order, "d").key, True)
    assert len(list(tmp_path.glob("quarantine/*.state"))) == (harm != "gone")
    with Ledger(tmp_path / "whole") as ledger:
        assert harmed.result == Dispatcher(ledger, Inline(), "d")([order])[0].result


def test_a_state_that_goes_while_its_job_waits_costs_time_only(order, tmp_path):
    first, second, _ = parts_of(order)
    with Ledger(tmp_path) as ledger:
        executor = Inline()
        do = Dispatcher(ledger, executor, "d")
        do([first])

        def lose(job):
            for file in tmp_path.glob("states/*"):
                file.unlink()
            executor.queue.append(job)

        executor.submit = lose
        assert do([second])[0].status == "done"


def test_a_worker_of_the_pool_hands_states_on_and_is_killed_on_the_way(order, tmp_path):
    first, _, last = parts_of(order)
    with Ledger(tmp_path / "pool") as ledger, LocalPool(1) as pool:
        do = Dispatcher(ledger, pool, "d")
        do([first])
        submit = pool.submit

        def kill_then(job):
            (worker,) = pool.processes()
            os.kill(worker, signal.SIGKILL)
            time.sleep(0.1)
            submit(job)

        pool.submit = kill_then
        found = do([last])[0]
    with Ledger(tmp_path / "whole") as ledger:
        assert found.result == Dispatcher(ledger, Inline(), "d")([order])[0].result


def test_a_disk_that_is_full_stops_the_search_and_loses_nothing(order, tmp_path, monkeypatch):
    first, second, _ = parts_of(order)
    written = os.fsync
    with Ledger(tmp_path) as ledger:
        do = Dispatcher(ledger, Inline(), "d")
        do([first])

        def full(handle):
            if os.fstat(handle).st_size > 2**13:  # room for records is left
                raise OSError(errno.ENOSPC, "No space left on device")
            written(handle)

        with monkeypatch.context() as patch:
            patch.setattr(edp.storage.writing.os, "fsync", full)
            outcome = do([second])[0]
        assert outcome.status == TrainingStatus.LOST  # which stops a search, and is tried again by the next
        assert "No space left" in outcome.message
        assert not list(tmp_path.rglob("*.tmp"))
        assert ledger.state(job_of_order(first, "d").key)
    with Ledger(tmp_path) as ledger:
        executor = Inline()
        assert Dispatcher(ledger, executor, "d")([second])[0].status == "done"
        assert executor.heard == [(job_of_order(second, "d").key, True)]


def test_what_a_killed_coordinator_left_is_taken_with_its_record_only(tmp_path, identity_of):
    with Ledger(tmp_path):
        pass
    done, cut_short = identity_of(0), identity_of(1)
    leave_state(tmp_path, done.key, b"one")
    leave_arrival(tmp_path, Record(done, TrainingStatus.DONE, {"score": 1.0}))
    leave_state(tmp_path, cut_short.key, b"two")
    with Ledger(tmp_path) as ledger:
        assert read_state(ledger.state(done.key)) == b"one"
        assert ledger.state(cut_short.key) is None
        assert os.listdir(tmp_path / "arrived") == []
        ledger.keep_states([])
        assert ledger.state(done.key) is None
        assert ledger.finished(done.key)


def gives_a_state(identity, where):
    return WithState({"score": 1.0}, b"here I was")


def gives_a_bad_result(identity, where):
    return WithState({"score": float("nan")}, b"here I was")


def test_a_worker_leaves_a_state_only_of_what_is_done(tmp_path, identity_of):
    with Ledger(tmp_path):
        pass
    for function, status in ((gives_a_state, TrainingStatus.DONE), (gives_a_bad_result, TrainingStatus.DIVERGED)):
        identity = dataclasses.replace(identity_of(0), job=f"{__name__}:{function.__name__}")
        assert perform(identity, {}, str(tmp_path), lambda: None).status == status
        assert state_path(tmp_path, identity.key).exists() == (status == TrainingStatus.DONE)


@pytest.fixture(scope="module")
def plan():
    return load_plan(None, "quick", CHANGES)


@pytest.fixture(scope="module")
def study(six_sessions, plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return run_search(six_sessions, plan, folder, CREW, until="calibration")


def untimed(folder):
    return [{**row, "seconds": 0} for row in read_study(folder).to_json()["history"]]


def test_a_study_shows_what_was_pruned_and_never_as_failed(study, plan):
    held = read_study(study.folder).to_json()
    trials = held["decisions"][1]["facts"]["backbones"]["lstm"]["trials"]
    ended = sum(trial["pruned"] for trial in trials)
    assert 0 < ended < 12
    phase = held["phases"][1]
    assert (phase["trainings"], phase["trained"], phase["pruned"], phase["failed"]) == (16, 16, ended, 0)
    rows = [row for row in held["history"] if row["phase"] == "calibration"]
    assert len(rows) == 16
    assert sum(row["status"] == "pruned" for row in rows) == ended
    assert all(row["rung"] in (2, 4) and row["score"] is None for row in rows if row["status"] == "pruned")
    assert all("rung" not in row for row in rows if row["status"] == "done")
    assert study.trained == held["counts"]["done"] == 24
    assert not list(study.folder.glob("ledger/states/*"))
    page = write_study_page(read_study(study.folder), study.folder / "report", pictures=False).page.read_text()
    assert f"{ended} of them pruned" in page
    assert "of them failed" not in page


def test_the_copy_for_the_dashboard_has_them_as_optuna_does(study):
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import TrialState

    file, _ = export_study(study.folder, study.folder / "copy.journal")
    held = optuna.load_study(study_name="calibration lstm", storage=JournalStorage(JournalFileBackend(str(file))))
    pruned = [trial for trial in held.trials if trial.state is TrialState.PRUNED]
    assert pruned
    assert {trial.state for trial in held.trials} == {TrialState.PRUNED, TrialState.COMPLETE}
    assert all(set(trial.intermediate_values) <= {2, 4} for trial in held.trials)
    assert all(trial.value == trial.intermediate_values[max(trial.intermediate_values)] for trial in pruned)


def test_a_study_that_is_stopped_between_rungs_again_and_again_comes_to_the_same(six_sessions, plan, study, tmp_path):
    stops = 0
    for _ in range(20):
        heard = []

        def stop(done, heard=heard, limit=15 + 5 * stops, **values):
            heard.append(1)
            if len(heard) > limit:
                raise Stop

        try:
            again = run_search(six_sessions, plan, tmp_path, CREW, "calibration", NotedProgress(stop))
            break
        except Stop:
            stops += 1
            assert look_at(tmp_path).study.state == "stopped"
    assert stops > 4
    assert (again.digest, again.context.decided) == (study.digest, study.context.decided)
    assert untimed(tmp_path) == untimed(study.folder)


def test_a_search_whose_states_cannot_be_written_is_stopped(six_sessions, plan, tmp_path, monkeypatch):
    def full(folder, key, state):
        raise StorageError("cannot write 'states': No space left on device; free space")

    monkeypatch.setattr("edp.jobs.perform.leave_state", full)
    with pytest.raises(LostError, match="No space left"):
        run_search(six_sessions, plan, tmp_path, CREW, "calibration")
    monkeypatch.undo()
    assert run_search(six_sessions, plan, tmp_path, CREW, "calibration").trained == 16
