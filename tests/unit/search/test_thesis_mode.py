"""A whole search by the preset `thesis`, with a tiny network and budget: real trainings of several epochs."""

import dataclasses

import pytest
from noted_progress import NotedProgress

from edp.config.experiment import load_experiment
from edp.evaluation.study import read_study
from edp.jobs.perform import perform
from edp.report import write_study_page
from edp.storage.ledger import Ledger
from edp.training.parts import fit_part
from edp.workflows.search.arms import Arm
from edp.workflows.search.engine import Dispatcher
from edp.workflows.search.jobs import job_of
from edp.workflows.search.plan import load_plan
from edp.workflows.search.runner import Resources, run_search
from edp.workflows.search.trainings import (
    TrainingRequest,
    experiment_of,
    prepared,
    train_part,
)

CHANGES = (
    'task={targets=["speed"], horizons=[1]}',
    'model={backbone={kind="hybrid", channels=[4], kernel=3, units=4}, window=5, head={hidden=2}}',
    'training={chunks={regime="window", length=5, batch=4, burn_in=0}, threads=1}',
    'search={horizon=1, backbones=["hybrid"], features=["all"], updates=6, final_updates=6, epochs=3, patience=1}',
    "search={folds=2, isolation={runs=4, seeds=2}, calibration={trials=3, warm_rounds=1}, screening={trials=1}}",
    "search.planning.most_runs=2",
    "search={run_seeds=2, synthesis={trials=2}, exploration={trials=3}, rungs=[0.3, 0.6]}",
    'search.compression={formats=["float32"], shares=[0.5]}',
    "search.space={units=[2, 4], layers=[1, 2], kernel=[3, 5]}",
)


class Inline:
    """Does jobs in this process, in their order, as a worker would."""

    workers = 1

    def __init__(self):
        self.queue = []

    def submit(self, job):
        self.queue.append(job)

    def wait_any(self, timeout_s=None):
        job = self.queue.pop(0)
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


CREW = Here(count=1)


class Stop(Exception):
    """Stands for Ctrl-C."""


@pytest.fixture(scope="module")
def plan():
    return load_plan(None, "thesis", CHANGES)


@pytest.fixture(scope="module")
def order(lever_sessions, plan):
    arm = Arm.from_experiment(plan.experiment)
    settings = arm.with_value("task.features", "all").with_value("training.schedule.patience", 0).tables
    source = lever_sessions.to_dict()
    names = ("s0", "s1", "s2"), ("s3", "s4")
    return TrainingRequest(settings, source, *names, seed=1, updates=24, epochs=8, patience=3, validation=names[1])


def test_a_training_has_epochs_a_schedule_that_acts_and_an_early_stop(order):
    training = experiment_of(order).training
    assert (training.epochs, training.updates, training.patience, training.refit) == (8, 3, 3, "none")
    # A rate at which nothing gets better: the first epoch stays the best, and three more are waited for.
    settings = Arm(order.settings).with_value("training.optimizer.learning_rate", 0.5).tables
    wild = dataclasses.replace(order, settings=settings)
    found = train_part(wild).result
    assert found["epochs"] == found["best_epoch"] + 3 < 8
    # What is judged is the best epoch: one that ends there and waits for nothing gives the same.
    short = dataclasses.replace(wild, epochs=found["best_epoch"] + 1, updates=3 * (found["best_epoch"] + 1), patience=0)
    assert train_part(short).result["sessions"] == found["sessions"]


def test_the_plateau_lowers_the_rate(order):
    plateau = {"kind": "plateau", "shrink": 0.5, "patience": 0, "threshold": 1e-4}
    arm = Arm(order.settings).with_value("training.optimizer.learning_rate", 0.5)
    wild = dataclasses.replace(order, settings=arm.with_value("training.schedule", plateau).tables, patience=0)
    experiment = experiment_of(wild)
    fitted, _ = fit_part(prepared(wild, experiment), experiment.model, experiment.training, windowed=True)
    rates = [row["learning_rate"] for row in fitted.history]
    assert rates[0] == 0.5
    assert min(rates) <= 0.25


def test_a_training_in_parts_of_epochs_is_the_training_without_them(order, tmp_path):
    whole = train_part(order)
    assert whole.state is None
    state = None
    for stop in (1, 3, 6):
        part = dataclasses.replace(order, until=stop)
        found = train_part(part, state)
        assert found.result["epochs"] <= stop
        assert train_part(part) == found
        state = found.state
    assert train_part(order, state) == whole
    with Ledger(tmp_path) as ledger:
        doing = Dispatcher(ledger, Inline(), "data")
        (first,) = doing([dataclasses.replace(order, until=3)])
        (last,) = doing([dataclasses.replace(order, stops=(3,))])
        assert first.status == last.status == "done"
        assert last.result["sessions"] == whole.result["sessions"]


def test_the_judging_sessions_validate_and_predictions_are_made_window_by_window(order):
    """The same training judged as a stream of one epoch's length differs: there the state is carried on."""
    one = dataclasses.replace(order, epochs=1, updates=24, patience=0, validation=())
    assert train_part(one).result["sessions"] != train_part(order).result["sessions"]
    identity = job_of(one, "data").identity
    assert "validation" not in identity.split
    assert "epochs" not in identity.config


@pytest.fixture(scope="module")
def finished(six_sessions, plan, tmp_path_factory):
    return run_search(six_sessions, plan, tmp_path_factory.mktemp("study"), CREW)


def test_all_phases_run_by_the_rules_of_the_thesis_and_leave_a_teacher(finished, plan):
    assert finished.state == "finished"
    teacher = load_experiment(finished.teacher, preset="thesis")
    assert teacher.model.backbone.units in (2, 4)
    study = read_study(finished.folder).to_json()
    assert study["mode"] == "thesis"
    assert study["counts"]["done"] == study["counts"]["asked"] == finished.trained
    assert {row["status"] for row in study["history"]} == {"done"}
    assert set(finished.context.decided["synthesis"].to_json()["facts"]["on"]) >= set(plan.spec.toggles)
    with Ledger(finished.folder / "ledger") as ledger:
        held = list(ledger)
    assert {record.identity.epochs for record in held} == {3}
    tests = {*finished.context.test, *finished.context.second}
    assert finished.context.decided["compression"].to_json()["facts"]["chosen"] is not None
    for record in held:
        split = record.identity.split
        assert not tests & {*split["train"], *split["validation"]}
        if "recipe" in record.identity.config:
            continue
        assert record.result["best_epoch"] <= record.result["epochs"] <= 3


def test_its_report_is_written_and_speaks_of_epochs(finished, tmp_path):
    write_study_page(read_study(finished.folder), tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "at most 3 epochs of 2 updates" in text
    assert "to the letter" not in text


@pytest.mark.slow
def test_stopped_again_and_again_it_comes_to_the_same(six_sessions, plan, finished, tmp_path):
    def stop_every_25(done, trained, **values):
        if trained >= 25:
            raise Stop

    trained = 0
    for _ in range(20):
        try:
            found = run_search(six_sessions, plan, tmp_path, CREW, progress=NotedProgress(stop_every_25))
        except Stop:
            trained += 25
            continue
        break
    assert trained + found.trained == finished.trained
    assert found.digest == finished.digest
