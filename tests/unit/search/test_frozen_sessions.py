"""Sessions that a search sets apart stay apart: in the study, and in every command on what comes of it."""

import hashlib
import shutil
from dataclasses import replace

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.config.experiment import load_experiment, plain_tree
from edp.data.frozen import SECOND_TEST_SET, ByFrozen, Session
from edp.errors import ConfigError, DataError
from edp.evaluation.controller import Budget
from edp.jobs.perform import perform
from edp.logs import read_recording, write_recording
from edp.logs.source import DataSource
from edp.storage import read_json
from edp.storage.ledger import Ledger
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.training.fit import Loop
from edp.training.transfer.spec import FinetuneSpec
from edp.workflows.compression import (
    CompressionSearchRequest,
    CompressionSearchSpec,
    DistilRequest,
    DistilSpec,
    distil,
    resource_usage,
    search,
)
from edp.workflows.compression.quantise import quantise
from edp.workflows.search.phases.compression import order_of, recipe_of, teacher_of
from edp.workflows.search.plan import load_plan
from edp.workflows.search.runner import Resources, run_search
from edp.workflows.search.smaller import Recipe, before, make_smaller
from edp.workflows.search.study_log import look_at
from edp.workflows.search.trainings import experiment_of
from edp.workflows.train_evaluate import evaluate, prepare_data, read_trained_run, train
from edp.workflows.transfer.finetune import FinetuneRequest, finetune

CHANGES = (
    'task={targets=["speed"], horizons=[1]}',
    'model={backbone={kind="lstm", units=4}, window=5, head={hidden=4}}',
    "training.chunks={length=20, batch=4, burn_in=5}",
    'search={horizon=1, backbones=["lstm"], features=["all"], updates=2, final_updates=3, folds=2, isolation={runs=4}}',
    "search={isolation={seeds=2}, calibration={trials=2}, screening={runs=16, repeats=1}, planning={most_runs=2}}",
    "search={run_seeds=1, batch=2}",
    "search={synthesis={trials=1}, exploration={trials=1}}",
    'search.compression={updates=3, units=[2], formats=["float32", "w8a16"]}',
    "search.space={units=[4, 8], kernel=false}",
)
TRAINING = ("training.epochs=1", "training.updates=3", "training.threads=1")


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


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def plan():
    return load_plan(None, "quick", CHANGES)


@pytest.fixture(scope="module")
def explored(six_sessions, plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frozen") / "study"
    run_search(six_sessions, plan, folder, Here(count=1), until="exploration")
    return folder


@pytest.fixture(scope="module")
def seen():
    """Contents of the series that a training saw: those of its gradients, and those that choose its epoch."""
    return []


@pytest.fixture(scope="module")
def study(explored, six_sessions, plan, seen, tmp_path_factory):
    folder = shutil.copytree(explored, tmp_path_factory.mktemp("finished") / "study")
    with watching(seen):
        return run_search(six_sessions, plan, folder, Here(count=1))


@pytest.fixture(scope="module")
def run(study, six_sessions, seen, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "teacher"
    with watching(seen):
        train(six_sessions, load_experiment(study.teacher, "quick", TRAINING), folder)
    return folder


class watching:
    """Every training notes the content of the series that it sees."""

    def __init__(self, notes):
        self.notes, self.patch = notes, pytest.MonkeyPatch()

    def __enter__(self):
        begin = Loop.__init__

        def init(loop, data, *rest, **named):
            self.notes += [content(series.targets) for series in [*data.train, *data.validation]]
            begin(loop, data, *rest, **named)

        self.patch.setattr(Loop, "__init__", init)

    def __exit__(self, *_):
        self.patch.undo()


def content(targets):
    return hashlib.sha256(np.ascontiguousarray(targets, dtype=np.float32).tobytes()).hexdigest()


def sealed(study, source):
    """Contents of the frozen sessions."""
    names = {*study.context.test, *study.context.second}
    task = load_experiment(study.teacher, "quick").task
    recordings = [recording for recording in source.read() if recording.name in names]
    resolved = task.resolve(100.0, recordings[0].channel_names)
    return {content(resolved.series(recording).targets) for recording in recordings}


def copied(source, folder, **names):
    for recording in source.read():
        name = names.get(recording.name, recording.name)
        write_recording(replace(recording, name=name), folder / f"{name}.parquet")
    return DataSource.from_path(folder)


def test_no_frozen_session_trains_or_chooses_from_the_study_to_the_compressed_network(
    study, run, six_sessions, seen, tmp_path
):
    with Ledger(study.folder / "ledger") as ledger:
        frozen = {*study.context.test, *study.context.second}
        assert len(frozen) == 2
        assert not any(frozen & set(record.identity.split["train"]) for record in ledger)
        opened = {key for one in ledger.openings() for key in one.judged}
        assert {r.key for r in ledger if frozen & set(r.identity.split["judged"])} == opened
        assert [one.test_set for one in ledger.openings()] == ["test sessions", SECOND_TEST_SET]
    need = resource_usage(load_bundle(run).predictor, "float32", Budget())
    budget = Budget(name="tight", parameter_bytes=need.parameter_bytes - 1)
    spec = CompressionSearchSpec(budget=budget, units=(2,), formats=("float32",))
    with watching(seen):
        found = search(run, CompressionSearchRequest(spec=spec, again=True), tmp_path / "small")
        distil(run, DistilRequest(spec=DistilSpec(units=2)), tmp_path / "student")
    quantise(run, tmp_path / "w8a16", ticks=50)
    assert len(seen) > 10
    assert not set(seen) & sealed(study, six_sessions)
    for folder in (run, *study.networks.values(), tmp_path / "student", tmp_path / "w8a16"):
        data = read_trained_run(folder)[3]
        assert {s.name for s in data.test} == set(study.context.test)
        assert {s.name for s in data.train} == set(study.context.training)
        assert {s.name for s in data.validation} == set(study.context.validation)
    assert found.held_out_test.name == SECOND_TEST_SET
    held = read_json(tmp_path / "small/compression.json")
    assert held["held_out_test"]["seen_before"]
    with Ledger(study.folder / "ledger") as ledger:
        assert len(ledger.openings(SECOND_TEST_SET)) == 2
    with pytest.raises(ConfigError, match="was opened on"):
        search(run, CompressionSearchRequest(spec=replace(spec, units=(1,))), tmp_path / "other")


def test_the_networks_of_phase_6_are_runs_like_any_other(study, tmp_path):
    facts = study.context.decided["compression"].to_json()["facts"]
    assert facts["held_out_test"] is not None
    row = facts["rows"][facts["chosen"]]
    chosen = study.networks.get("chosen", study.networks["teacher"])
    assert load_bundle(chosen).predictor.spec.backbone.units == row["units"] or row["units"] is None
    scores = read_json(evaluate(chosen, baselines=()) / "scores.json")["models"]["network"]
    assert set(scores["recordings"]) == set(study.context.test)
    assert look_at(study.folder).study.phases[-1].name == "compression"


def test_a_frozen_session_under_another_name_is_still_frozen(study, run, six_sessions, tmp_path):
    (test,), (second,) = study.context.test, study.context.second
    source = copied(six_sessions, tmp_path / "logs", **{test: "a_new_day", second: "b_new_day"})
    copy = replace(read_recording(tmp_path / "logs/a_new_day.parquet"), name="c_copy")
    write_recording(copy, tmp_path / "logs/c_copy.parquet")
    data = prepare_data(source, load_experiment(study.teacher, "quick"))
    assert [series.name for series in data.test] == ["a_new_day"]
    assert {s.name for s in [*data.train, *data.validation]} == set(study.context.development)
    opened = prepare_data(source, replaced(study, lambda split: split.opened()))
    assert [series.name for series in opened.test] == ["b_new_day"]
    with pytest.raises(DataError, match=f"'a_new_day' .* is the frozen session '{test}'"):
        finetune(run, source, FinetuneRequest(spec=FinetuneSpec()), tmp_path / "fine")
    with pytest.raises(DataError, match=f"is the frozen session '{test}'.*learn from it"):
        distil(run, DistilRequest(spec=DistilSpec(units=2), further=source), tmp_path / "student")
    assert not (tmp_path / "student").exists()


def replaced(study, change):
    experiment = load_experiment(study.teacher, "quick")
    return replace(experiment, split=change(experiment.split))


def test_a_frozen_session_that_is_missing_changed_or_cut_is_told(study, six_sessions, tmp_path):
    (test,), (second,) = study.context.test, study.context.second
    experiment = load_experiment(study.teacher, "quick")
    source = copied(six_sessions, tmp_path)
    (tmp_path / f"{second}.parquet").unlink()
    with pytest.raises(DataError, match=rf"1 of 2 frozen sessions.*{second}; no recording has their content"):
        prepare_data(source, experiment)
    source = copied(six_sessions, tmp_path)
    whole = read_recording(tmp_path / f"{test}.parquet")
    write_recording(replace(whole, values=whole.values * np.float32(1.001)), tmp_path / f"{test}.parquet")
    with pytest.raises(DataError, match=f"'{test}' is there with another content"):
        prepare_data(source, experiment)
    source = copied(six_sessions, tmp_path)
    write_recording(whole.rows(40, 240, "piece"), tmp_path / "piece.parquet")
    with pytest.raises(DataError, match=f"'piece' .* different rows with the frozen session '{test}'"):
        prepare_data(source, experiment)


def test_other_data_are_drawn_only_when_that_is_said(study, run, six_sessions, tmp_path):
    for recording in six_sessions.read():
        moved = replace(recording, values=recording.values + np.float32(1))
        write_recording(moved, tmp_path / f"{recording.name}.parquet")
    other = DataSource.from_path(tmp_path)
    with pytest.raises(DataError, match=r"2 of 2 frozen sessions.*split\.on_missing=resample"):
        prepare_data(other, load_experiment(study.teacher, "quick"))
    drawn = prepare_data(other, load_experiment(study.teacher, "quick", ["split.on_missing=resample"]))
    assert (len(drawn.train), len(drawn.validation), len(drawn.test)) == (4, 1, 1)
    with pytest.raises(ConfigError, match="lets go of 2 of its frozen sessions"):
        distil(run, DistilRequest(spec=DistilSpec(units=2), changes=("split.kind=time",)), tmp_path / "student")


@pytest.mark.parametrize("harm", ["none", "states are lost"])
def test_phase_6_killed_after_each_training_comes_to_the_same(
    explored, study, six_sessions, plan, harm, tmp_path, monkeypatch
):
    folder = shutil.copytree(explored, tmp_path / "study")
    sittings = 0

    def kill(done, trained, **values):
        if trained >= (2 if harm == "none" else 1):
            raise Killed

    for _ in range(20):
        try:
            found = run_search(six_sessions, plan, folder, Here(count=1), progress=NotedProgress(kill))
        except Killed:
            sittings += 1
            if harm != "none":
                shutil.rmtree(folder / "ledger/states")
            continue
        break
    assert sittings >= 2
    assert found.digest == study.digest
    assert found.context.decided["compression"] == study.context.decided["compression"]
    for name, network in found.networks.items():
        ours, theirs = (weights_digest(load_bundle(one).predictor) for one in (network, study.networks[name]))
        assert ours == theirs


def test_a_split_that_contradicts_itself_is_refused():
    session = Session(name="a", digest="1")
    with pytest.raises(ConfigError, match="'a' is in test and in train"):
        ByFrozen(test=(session,), train=(session,))
    with pytest.raises(ConfigError, match="missing = 'maybe'"):
        ByFrozen(on_missing="maybe")
    with pytest.raises(ConfigError, match="names no test sessions"):
        ByFrozen().split([], 1)
    with pytest.raises(ConfigError, match="no second sealed test set"):
        ByFrozen(test=(session,)).opened()
    assert plain_tree(ByFrozen(test=(session,)), "split")["test"] == [{"name": "a", "digest": "1"}]


def test_a_network_of_several_epochs_is_the_same_from_a_state_and_from_nothing(study, plan):
    context = replace(study.context, spec=replace(plan.spec, mode="thesis", epochs=3, updates=6, final_updates=6))
    recipe = replace(recipe_of(context), units=2, rounded=True, final="w8a16")
    order = order_of(context, teacher_of(context), recipe, context.second)
    assert (order.epochs, order.validation) == (3, context.validation)
    assert not set(order.train) & {*context.validation, *context.test, *context.second}
    whole = make_smaller(order)
    assert whole.state is None
    earlier = before(order)
    requests = [Recipe.from_json(one.recipe).order() for one in earlier]
    assert [request and request.name for request in requests] == ["u2_qat", "u2", None]
    assert not any(set(one.judged) & set(context.second) for one in earlier)
    for one in earlier:
        assert make_smaller(order, make_smaller(one).state) == whole
    experiment = Recipe.from_json(order.recipe).experiment(experiment_of(order))
    assert (experiment.training.epochs, experiment.training.updates) == (1, 1)
