"""A whole search on five tiny sessions: real trainings, real stops, wrong input."""

import json
from dataclasses import replace

import pytest
from noted_progress import NotedProgress

from edp.config.experiment import load_experiment
from edp.errors import BusyError, ConfigError, DataError, LostError, StorageError
from edp.evaluation.study import read_study
from edp.jobs.base import ended
from edp.jobs.perform import perform
from edp.logs import read_recording, write_recording
from edp.logs.source import DataSource
from edp.storage import write_json
from edp.storage.ledger import Ledger, TrainingStatus
from edp.workflows.search.plan import SearchPlan, load_plan
from edp.workflows.search.runner import Resources, run_search
from edp.workflows.search.settings import MOVED, IsolationSpec, PlanningSpec
from edp.workflows.search.study_log import look_at

CHANGES = (
    'task={targets=["speed"], horizons=[1]}',
    'model={backbone={kind="lstm", units=4}, window=5, head={hidden=4}}',
    "training.chunks={length=20, batch=4, burn_in=5}",
    'search={horizon=1, backbones=["lstm"], features=["all"], updates=3, final_updates=4, folds=2, isolation={runs=4}}',
    'search.compression={updates=3, formats=["float32", "w8a16"], shares=[1.0, 0.5]}',
    "search={isolation={seeds=2}, calibration={trials=3}, screening={repeats=1}, planning={most_runs=4}, run_seeds=1}",
    "search={synthesis={trials=2}, exploration={trials=2}}",
    "search.space={units=[2, 4], kernel=false}",
)


class Inline:
    """Does jobs in this process, in their order, as a worker would; the pool itself has its own tests."""

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
    return load_plan(None, "quick", CHANGES)


@pytest.fixture(scope="module")
def finished(six_sessions, plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return run_search(six_sessions, plan, folder, CREW)


def test_all_phases_run_and_leave_a_teacher_that_can_be_trained(finished, plan):
    assert finished.state == "finished"
    assert list(finished.context.decided) == [
        "isolation",
        "calibration",
        "screening",
        "planning",
        "confirmation",
        "synthesis",
        "exploration",
        "compression",
    ]
    teacher = load_experiment(finished.teacher, preset="quick")
    assert teacher.task.targets == plan.experiment.task.targets
    assert teacher.model.backbone.units in (2, 4)
    study = read_study(finished.folder).to_json()
    assert study["state"] == "finished"
    assert study["unit"] == "mm/s"
    assert study["counts"]["done"] == study["counts"]["asked"] == study["counts"]["total"] == finished.trained
    assert {row["status"] for row in study["history"]} == {"done"}
    assert [row["number"] for row in study["history"]] == list(range(finished.trained))
    assert sum(phase["trainings"] for phase in study["phases"]) == finished.trained


def test_the_test_sessions_judge_only_behind_the_recorded_opening(finished):
    with Ledger(finished.folder / "ledger") as ledger:
        sealed = {r.key for r in ledger if set(r.identity.split["judged"]) & set(finished.context.test)}
        second = {r.key for r in ledger if set(r.identity.split["judged"]) & set(finished.context.second)}
        opening, last = ledger.openings()
    assert sealed == set(opening.judged)
    assert second == set(last.judged)
    assert len(second) in (1, 2)
    assert len(sealed) in (1, 2)  # winner and baseline may be the same network
    assert [one.test_set for one in read_study(finished.folder).openings] == [
        "test sessions",
        "second test sessions",
    ]


def test_a_search_that_was_stopped_again_and_again_trains_nothing_twice_and_finds_the_same(
    six_sessions, plan, finished, tmp_path
):
    done = []

    def stop_every_30(done, trained, **values):
        if trained >= 30:
            raise Stop

    trained = 0
    for _ in range(20):
        try:
            found = run_search(six_sessions, plan, tmp_path, CREW, progress=NotedProgress(stop_every_30))
        except Stop:
            status = look_at(tmp_path)
            assert status.study.state == "stopped"
            assert status.holder is None
            trained += 30
            done.append(status.study.counts.done)
            continue
        trained += found.trained
        break
    assert len(done) > 1
    assert trained == finished.trained
    assert found.digest == finished.digest
    ours, theirs = (read_study(folder).to_json() for folder in (tmp_path, finished.folder))
    for part in ("decisions", "sessions", "spec", "data"):
        assert ours[part] == theirs[part]
    untimed = [[{**row, "seconds": 0} for row in study["history"]] for study in (ours, theirs)]
    assert untimed[0] == untimed[1]
    again = run_search(six_sessions, plan, tmp_path, CREW)
    assert again.trained == 0
    assert again.digest == finished.digest


def test_phases_up_to_one_and_then_the_rest(six_sessions, plan, tmp_path):
    first = run_search(six_sessions, plan, tmp_path, CREW, until="isolation")
    assert (first.state, list(first.context.decided), first.teacher) == ("stopped", ["isolation"], None)
    second = run_search(six_sessions, plan, tmp_path, CREW, until="calibration")
    assert second.trained == plan.spec.calibration.trials


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ("search.space.units=[2, 8]", "space"),
        ("search.updates=4", "search"),
        ("model.window=6", "network"),
    ],
)
def test_a_study_of_other_settings_is_not_gone_on_with(six_sessions, finished, change, part):
    other = load_plan(None, "quick", (*CHANGES, change))
    before = finished.folder.joinpath("study.json").read_bytes()
    with pytest.raises(ConfigError, match=rf"other {part}; nothing was changed"):
        run_search(six_sessions, other, finished.folder, CREW)
    assert finished.folder.joinpath("study.json").read_bytes() == before


def copied(source, folder):
    for file in sorted(source.path.glob("*.parquet")):
        write_recording(read_recording(file), folder / file.name)
    return DataSource.from_path(folder)


def test_other_data_in_the_same_folder_are_refused(six_sessions, plan, finished, tmp_path):
    source = copied(six_sessions, tmp_path)
    first = read_recording(tmp_path / "s0.parquet")
    values = first.values.copy()
    values[7, 0] += 1
    write_recording(replace(first, values=values), tmp_path / "s0.parquet")
    with pytest.raises(ConfigError, match="begun with other data"):
        run_search(source, plan, finished.folder, CREW)


def test_the_same_session_twice_is_refused_before_anything_is_trained(six_sessions, plan, tmp_path):
    source = copied(six_sessions, tmp_path / "logs")
    write_recording(replace(read_recording(tmp_path / "logs/s0.parquet"), name="again"), tmp_path / "logs/z.parquet")
    with pytest.raises(DataError, match="'again' and 's0' are the same session"):
        run_search(source, plan, tmp_path / "study", CREW)
    assert not (tmp_path / "study").exists()


def test_fewer_sessions_than_folds_and_a_test_session_that_is_not_there(six_sessions, plan, tmp_path):
    many = replace(plan.spec, folds=5, isolation=IsolationSpec(runs=10), planning=PlanningSpec(max_runs=10))
    named = replace(plan.spec, test=("s9",))
    # A store cannot be divided into more sessions.
    six_sessions.store(tmp_path / "store")
    with pytest.raises(DataError, match="4 are left for 5 folds"):
        run_search(DataSource(tmp_path / "store"), SearchPlan(many, plan.experiment), tmp_path / "a", CREW)
    with pytest.raises(ConfigError, match=r"'s9'.*known: s0, s1"):
        run_search(six_sessions, SearchPlan(named, plan.experiment), tmp_path / "b", CREW)


def test_a_feature_set_that_the_recordings_do_not_have(six_sessions, plan, tmp_path):
    other = SearchPlan(replace(plan.spec, features=("all", "FG2")), plan.experiment)
    with pytest.raises(DataError, match=r"feature set FG2 cannot be had of 's0'.*search\.features"):
        run_search(six_sessions, other, tmp_path, CREW)


def test_a_second_coordinator_is_refused(six_sessions, plan, finished):
    with Ledger(finished.folder / "ledger"), pytest.raises(BusyError, match="coordinated by process"):
        run_search(six_sessions, plan, finished.folder, CREW)


def test_damaged_records_are_set_apart_and_trained_again(six_sessions, plan, tmp_path):
    run_search(six_sessions, plan, tmp_path, CREW, until="isolation")
    digest = run_search(six_sessions, plan, tmp_path, CREW, until="isolation").digest
    records = sorted((tmp_path / "ledger/records").glob("*.json"))
    records[0].write_bytes(records[0].read_bytes()[:-40])
    progress = NotedProgress()
    again = run_search(six_sessions, plan, tmp_path, CREW, "isolation", progress)
    assert "1 damaged records were set apart" in progress.notes[0]
    assert (again.trained, again.digest) == (1, digest)


def test_trainings_that_all_fail_are_told_with_their_reason(six_sessions, plan, tmp_path):
    beyond = load_plan(None, "quick", (*CHANGES, "evaluation.warmup_samples=5000"))
    with pytest.raises(DataError, match=r"all 8 trainings of a batch failed; the first says: "):
        run_search(six_sessions, beyond, tmp_path, CREW)
    assert read_study(tmp_path).phases[0].failed == 8


def test_a_lost_training_stops_the_search_and_is_tried_again(six_sessions, plan, tmp_path):
    class Killed(Inline):
        def wait_any(self, timeout_s=None):
            return ended(
                self.queue.pop(0), TrainingStatus.LOST, "its process ended 3 times, last by signal 9", attempts=3
            )

    class Unlucky(Resources):
        def open(self):
            return Killed()

    with pytest.raises(LostError, match=r"8 trainings lost.*signal 9.*same command again") as told:
        run_search(six_sessions, plan, tmp_path, Unlucky(count=1), "isolation")
    assert told.value.exit_code == 75
    assert run_search(six_sessions, plan, tmp_path, CREW, "isolation").trained == 8


def test_status_of_no_study_and_of_one_of_another_version(finished, tmp_path):
    with pytest.raises(StorageError, match="holds no study"):
        look_at(tmp_path)
    held = json.loads((finished.folder / "study.json").read_text())
    write_json(tmp_path / "study.json", held | {"schema": 99})
    with pytest.raises(StorageError, match="schema 99"):
        look_at(tmp_path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("search.calibration.trails=3", "did you mean 'trials'"),
        ("search.trials=3", "'search.trials' is now called 'search.calibration.trials'"),
        ("search.space.units=[1]", "units: a choice of"),
        ("search.space.untis=[1, 2]", "unknown dimension 'search.space.untis'; did you mean 'units'"),
        ("search.space.units=3", "units = 3; a list of values"),
        ('search.space.units=["a", "b"]', "units = 'a' cannot be for lstm"),
        ("search.space.learning_rate={low=1, high=0.1}", "low < high"),
        ("search.horizon=7", "the task predicts 1 samples ahead"),
        ('search.backbones=["lstn"]', "did you mean 'lstm'"),
        ('search.features=["FG9"]', "there is no feature set 'FG9'"),
        ('search.features=["no.toml"]', "no.toml"),
        ("base=qick", "did you mean 'quick'"),
        ("search=3", "expected a table"),
    ],
)
def test_wrong_settings_are_told_before_anything_is_read(change, match):
    with pytest.raises((ConfigError, StorageError), match=match):
        load_plan(None, "quick", (*CHANGES, change))


@pytest.mark.parametrize("preset", ["quick", "standard", "thesis"])
def test_presets_can_be_built(preset):
    plan = load_plan(None, preset)
    assert plan.spec.horizon in plan.experiment.task.horizons
    assert plan.to_dict()["search"]["folds"] == plan.spec.folds


def test_the_identity_of_a_study_is_that_of_versions_without_tables_for_phases(plan):
    identity = plan.to_dict()["search"]
    assert (identity["variance_runs"], identity["free_trials"]) == (
        plan.spec.isolation.runs,
        plan.spec.exploration.trials,
    )
    assert identity.keys() >= MOVED.keys()
    assert not {moved.partition(".")[0] for moved in MOVED.values()} & identity.keys()


def test_an_own_feature_set_by_its_file(tmp_path):
    (tmp_path / "own.toml").write_text('name = "levers"\nchannels = ["lever"]\n')
    (tmp_path / "search.toml").write_text('[search]\nfeatures = ["FG1", "own.toml"]\n')
    plan = load_plan(tmp_path / "search.toml", "quick")
    assert list(plan.spec.feature_sets) == ["FG1", "levers"]
    assert plan.spec.feature_sets["levers"]["channels"] == ["lever"]
