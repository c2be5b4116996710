"""The preset auto: what it chooses, what it promises, what it writes and refuses."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from noted_progress import NotedProgress

from edp.data.splits import SPLITS
from edp.errors import ConfigError, DataError, StorageError
from edp.evaluation.guard import beaten_by
from edp.evaluation.scores_file import ScoresFile
from edp.jobs import Workers
from edp.report import build_report
from edp.report.run.choice import model_tables, read_choice
from edp.report.run.facts import read_facts
from edp.storage import read_json, write_json
from edp.training import load_bundle
from edp.wording import MISSING
from edp.workflows.auto import load_auto, train_auto
from edp.workflows.auto.candidates import CANDIDATES, Amount, RecurrentTrial, spans_of, tree_plan
from edp.workflows.auto.promise import Promise, choose
from edp.workflows.train_evaluate import DataSource, evaluate, read_trained_run

pytestmark = pytest.mark.processes

RATE = 50.0
SET = [
    "task.targets=['y']",
    "task.horizons=[1, 4]",
    "auto.time_budget_min=0.01",
    "split.kind='time'",
    "evaluation.baselines=[]",
]


def write(folder, y=None, ticks=900, seed=0, u=None):
    """A log of a saturated plant as a CSV with a map."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2, 2, ticks // 10 + 1), 10)[:ticks] if u is None else u
    if y is None:
        y = np.zeros(ticks)
        for tick in range(1, ticks):
            y[tick] = 0.9 * y[tick - 1] + 0.3 * np.tanh(2 * u[tick - 1]) + 0.01 * rng.normal()
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{tick / RATE:.4f},{a:.6f},{b:.6f}" for tick, (a, b) in enumerate(zip(u, y, strict=True))]
    (folder / "log.csv").write_text("time,u,y\n" + "\n".join(rows) + "\n")
    (folder / "map.toml").write_text(
        'time = "time"\n[channels.u]\ncolumn = "u"\nkind = "generic"\n[channels.y]\ncolumn = "y"\nkind = "generic"\n'
    )
    return DataSource.from_path(folder / "log.csv", folder / "map.toml")


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("auto")
    source = write(folder / "logs")
    return source, folder / "run", train_auto(source, load_auto(None, SET), folder / "run")


def test_the_run_is_that_of_the_chosen_candidate(result):
    _, folder, found = result
    assert found.choice.to_table()["chosen"] in found.choice.to_table()["candidates"]
    assert json.loads((folder / "auto.json").read_text())["sentence"] == found.sentence
    bundle, experiment, provenance, _ = read_trained_run(folder)
    assert provenance.more["auto"] == found.sentence
    assert experiment.training.ensemble is not None
    assert load_bundle(folder).predictor.spec == bundle.predictor.spec
    for one in found.choice.to_table()["candidates"].values():
        assert set(one["promise"]) == {"1", "4"}
        assert set(one["promise"]["1"]) == {"y"}


def test_the_promise_is_kept_on_the_test_part(result):
    _, folder, found = result
    evaluate(folder)
    scores = json.loads((folder / "scores.json").read_text())["models"]["network"]["overall"]
    for horizon, promised in found.choice.to_table()["candidates"][found.choice.to_table()["chosen"]][
        "promise"
    ].items():
        assert scores[horizon]["y"]["rmse"] < 1.5 * promised["y"]
        assert scores[horizon]["y"]["rmse"] < found.choice.persistence[horizon]["y"]


def test_a_finished_run_is_read_again_and_another_one_refused(result):
    source, folder, _ = result
    before = (folder / "auto.json").read_bytes()
    assert train_auto(source, load_auto(None, SET), folder).choice.to_table() == read_json(folder / "auto.json")
    with pytest.raises(StorageError, match="another run"):
        train_auto(source, load_auto(None, [*SET, "auto.seed=1"]), folder)
    assert (folder / "auto.json").read_bytes() == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["model.window=5"], "chooses the network"),
        (["training.epochs=5"], "chooses the network"),
        (["auto.time_budget_min=0"], "time_budget_min = 0"),
        (["auto.seconds=5"], "did you mean|unknown"),
        (["auto.candidates=['liner']"], "linear"),
        (["auto.candidates=['recurrent']"], "suits"),
        (["task.targets=['z']"], "no channel"),
        (["task.horizons=[400]"], "longer|horizon"),
    ],
)
def test_settings_that_cannot_be_are_one_error(tmp_path, settings, message):
    source = write(tmp_path / "logs")
    with pytest.raises((ConfigError, DataError), match=message):
        train_auto(source, load_auto(None, [*SET, *settings]), tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_run_that_was_killed_while_it_was_written_is_made_again(result, tmp_path):
    source, folder, found = result
    copied = shutil.copytree(folder, tmp_path / "run")
    (copied / "status.json").unlink()
    shutil.rmtree(copied / "bundle")
    again = train_auto(source, load_auto(None, SET), copied)
    assert again.choice.to_table()["excess"] == found.choice.to_table()["excess"]
    assert (copied / "bundle").is_dir()


@pytest.mark.parametrize(
    "change",
    [
        {"candidates": []},
        {"candidates": {"linear": 5}},
        {"chosen": ["linear"]},
        {"sentence": 5},
        {"excess": {"linear": "x"}},
        {"minutes": None},
        {"persistence": {"1": 5}},
        {"key": 5},
    ],
)
def test_a_changed_file_is_refused(result, tmp_path, change):
    source, folder, _ = result
    copied = shutil.copytree(folder, tmp_path / "run")
    facts = json.loads((copied / "auto.json").read_text())
    write_json(copied / "auto.json", facts | change)
    with pytest.raises(StorageError, match=r"auto\.json"):
        train_auto(source, load_auto(None, SET), copied)
    with pytest.raises(StorageError, match=r"auto\.json"):
        build_report(copied)


def test_the_report_says_why(result, tmp_path):
    _, folder, found = result
    copied = shutil.copytree(folder, tmp_path / "run")
    evaluate(copied, baselines=("persistence",))
    page = build_report(copied).read_text()
    assert "Why this model" in page
    assert "What left-out data promised" in page
    assert found.sentence[:40].replace(" ", "") in "".join(page.split())


def test_a_network_with_a_validation_part_of_its_own_is_compared_on_that_part(tmp_path, monkeypatch):
    monkeypatch.setattr("edp.workflows.auto.candidates.RECURRENT_ROWS", 1000)
    source = write(tmp_path / "logs", ticks=1500)
    settings = load_auto(None, [*SET, "auto.candidates=['linear', 'recurrent']"])
    facts = train_auto(source, settings, tmp_path / "run").choice.to_table()
    assert set(facts["candidates"]) == {"linear", "recurrent"}
    linear, recurrent = (facts["candidates"][name]["promise"]["4"]["y"] for name in ("linear", "recurrent"))
    # A network of a few updates hardly beats the mean change; the linear model does.
    assert facts["chosen"] == "linear"
    assert linear < recurrent < 3 * facts["persistence"]["4"]["y"]


@pytest.mark.parametrize(
    ("lengths", "kind"),
    [((900,), "time"), ((900, 900, 900), "names"), ((4000, 200), "time"), ((150,) * 9, "names")],
)
def test_recordings_are_divided_by_time_where_whole_ones_are_no_parts(tmp_path, lengths, kind):
    for number, ticks in enumerate(lengths):
        write(tmp_path / "logs", ticks=ticks, seed=number)
        (tmp_path / "logs" / "log.csv").rename(tmp_path / "logs" / f"{number}.csv")
    (tmp_path / "logs" / "map.toml").rename(tmp_path / "map.toml")
    source = DataSource.from_path(tmp_path / "logs", tmp_path / "map.toml")
    settings = [*SET[:3], "auto.candidates=['linear']", "evaluation.baselines=[]"]
    train_auto(source, load_auto(None, settings), tmp_path / "run")
    _, experiment, _, data = read_trained_run(tmp_path / "run")
    assert SPLITS.name_of(experiment.split) == kind
    assert sum(part.samples for part in data.train) > 0.5 * sum(lengths)


def test_candidates_side_by_side_give_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr("edp.workflows.auto.candidates.RECURRENT_ROWS", 1000)
    source = write(tmp_path / "logs", ticks=1500)
    settings = load_auto(None, [*SET, "auto.candidates=['linear', 'recurrent']"])
    told, runs = [], []
    for workers in (1, 2):
        folder = tmp_path / f"run{workers}"
        told.append(NotedProgress())
        train_auto(source, settings, folder, told[-1], Workers(count=workers))
        runs.append(folder)
        left = sorted(path.name for path in (folder / "candidates").iterdir())
        assert left == ["recurrent"]  # whose checkpoint a stopped run goes on from
        assert not (folder / "candidates" / "recurrent" / "progress.json").exists()
    facts = [read_json(folder / "auto.json") for folder in runs]
    for each in facts:
        for candidate in each["candidates"].values():
            del candidate["seconds"]
    assert facts[0] == facts[1]
    assert [stage for stage in told[0].stages if stage[0] == "model"] == [("model", 2)]
    assert len(told[0].notes) == 2
    states = [load_bundle(folder).predictor.state_dict() for folder in runs]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_page_and_file_show_every_model_on_left_out_data_and_on_the_test_part(result, tmp_path):
    source, folder, found = result
    copied = shutil.copytree(folder, tmp_path / "run")
    evaluate(copied, baselines=("persistence", "ridge_arx"))
    results = json.loads((copied / "auto.json").read_text())["results"]
    assert set(results) == {"network", "persistence", "ridge_arx"}
    assert "validation" not in results["network"]  # it trained on that part; its promise is from rows left out
    facts = read_facts(copied)
    models = facts.scores.models
    for name in ("persistence", "ridge_arx"):
        assert results[name]["test"]["4"]["y"] == models[name].overall["4"]["y"]["rmse"]
        assert results[name]["validation"]["4"]["y"] == models[name].validation["4"]["y"]["rmse"]
        assert results[name]["validation"] != results[name]["test"]
    (table,) = model_tables(facts, read_choice(copied))
    rows = {cells[0]: cells[1:] for cells in table.rows}
    assert list(rows)[-2:] == ["Persistence", "Ridge ARX"]
    assert len(rows) == len(found.choice.to_table()["candidates"]) + 2
    kept = found.choice.to_table()["candidates"][found.choice.to_table()["chosen"]]
    (marked,) = table.marked
    assert table.rows[marked][0] == kept["label"]
    promise, test = (float(cell) for cell in rows[kept["label"]][-2:])
    assert promise == pytest.approx(kept["promise"]["4"]["y"], rel=0.01)
    assert test == pytest.approx(models["network"].overall["4"]["y"]["rmse"], rel=0.01)
    others = [
        cells for label, cells in rows.items() if label in {"the linear model", "the committee"} - {kept["label"]}
    ]
    assert all(cells[1] == cells[3] == MISSING for cells in others)  # the test part was opened for one model alone
    assert "Every model, output by output" in build_report(copied).read_text()
    assert train_auto(source, load_auto(None, SET), copied).choice.to_table()["results"] == results


def test_a_target_that_never_moves_is_refused(tmp_path):
    source = write(tmp_path / "logs", y=np.full(900, 2.0))
    with pytest.raises(DataError, match="never moves"):
        train_auto(source, load_auto(None, SET), tmp_path / "run")


def test_inputs_that_never_move_are_refused(tmp_path):
    source = write(tmp_path / "logs", u=np.full(900, 0.5), y=np.sin(np.arange(900) / 20))
    features = ["task.features={name='u', channels=['u']}", "task.mode='absolute'"]
    with pytest.raises(DataError, match="no input moves"):
        train_auto(source, load_auto(None, [*SET, *features]), tmp_path / "run")


def test_of_equal_models_the_simplest_is_chosen():
    rng = np.random.default_rng(0)
    noise = rng.uniform(0.9, 1.1, size=(10, 2))
    rows = np.full(10, 100.0)
    simple, better = Promise(noise, rows), Promise(noise * rng.uniform(0.97, 1.02, size=(10, 1)), rows)
    assert choose({"simple": simple, "better": better}).name == "simple"
    clear = Promise(noise * rng.uniform(0.6, 0.7, size=(10, 1)), rows)
    choice = choose({"simple": simple, "clear": clear})
    assert (choice.name, choice.best) == ("clear", "clear")
    assert choice.excess["simple"] > choice.doubt["simple"]
    assert choice.excess["simple"] == pytest.approx(np.log(simple.error() / clear.error()).mean(), rel=0.05)


def test_an_advantage_while_the_machine_idles_decides_nothing():
    idle, rows = np.full((19, 1), 1e-8), np.full(20, 50.0)
    simple = Promise(np.vstack([idle, [[1.0]]]), rows)
    quiet = Promise(np.vstack([0.5 * idle, [[1.01]]]), rows)
    assert choose({"simple": simple, "quiet": quiet}).best == "simple"


def test_a_single_outlier_does_not_decide_against_all_other_blocks():
    rng = np.random.default_rng(0)
    plain, rows = rng.uniform(0.9, 1.1, size=(40, 1)), np.full(40, 50.0)
    outlier = np.eye(40)[:, :1]
    simple, better = Promise(plain + 60 * outlier, rows), Promise(0.7 * plain + 80 * outlier, rows)
    assert (better.error() > simple.error()).all()
    assert choose({"simple": simple, "better": better}).name == "better"


def test_candidates_that_left_out_fewer_blocks_are_compared_on_those():
    rng = np.random.default_rng(0)
    squared = rng.uniform(0.9, 1.1, size=(30, 1))
    whole, part = Promise(squared, np.full(30, 10.0)), Promise(0.5 * squared[-10:], np.full(10, 10.0))
    choice = choose({"whole": whole, "part": part})
    assert choice.name == "part"
    assert choice.excess["whole"] == pytest.approx(0.5 * np.log(2))


def test_spans_grow_with_the_horizon_as_far_as_the_data_allow():
    amount = Amount(rows=100_000, shortest=100_000, features=5, outputs=2, horizon=10, minutes=5.0)
    assert spans_of(amount).lags == [1, 2, 3, 4, 6, 8, 12, 16, 24, 32]
    assert spans_of(amount).smoothed == [4, 8, 16, 32]
    assert spans_of(replace(amount, horizon=100)).lags[-1] == 256
    assert spans_of(replace(amount, shortest=80)).lags[-1] == 8
    assert CANDIDATES["recurrent"].plan(replace(amount, rows=5000)) is None
    assert CANDIDATES["recurrent"].plan(replace(amount, shortest=140)) is not None
    assert CANDIDATES["recurrent"].plan(replace(amount, shortest=140, horizon=100)) is None
    assert CANDIDATES["committee"].plan(amount).model.backbone.local_lags == ()
    backbone = CANDIDATES["committee"].plan(replace(amount, rows=5000, shortest=40)).model.backbone
    assert (backbone.lags, backbone.local_lags) == ((1, 2, 3, 4), (0, 1, 2, 4))
    steps = [
        CANDIDATES["committee"].plan(replace(amount, minutes=minutes)).training.ensemble.steps
        for minutes in (0.01, 1.0, 100.0)
    ]
    assert steps == sorted(steps)
    assert steps[0] < steps[-1]


def test_the_budget_of_long_recordings_goes_to_the_recurrent_network():
    short = Amount(rows=100_000, shortest=1_000, features=12, outputs=3, horizon=10, minutes=5.0)
    long = replace(short, rows=100_001)
    kinds = ("perceptrons", "trees", "recurrent")
    for amount, most in ((short, "trees"), (long, "recurrent")):
        seconds = {kind: amount.seconds(kind) for kind in kinds}
        assert 240.0 < sum(seconds.values()) < 300.0  # the rest is for linear models and radial basis functions
        assert seconds[most] >= max(seconds.values())


def test_the_budget_follows_the_trial_of_the_recurrent_network():
    kinds = ("perceptrons", "trees", "recurrent")
    for rows in (60_000, 300_000):
        amount = Amount(rows=rows, shortest=1_000, features=12, outputs=3, horizon=10, minutes=5.0)
        seconds = {
            trial: {kind: replace(amount, trial=trial).seconds(kind) for kind in kinds} for trial in RecurrentTrial
        }
        assert seconds[RecurrentTrial.RUNNING]["perceptrons"] == 0
        assert 0 < seconds[RecurrentTrial.RUNNING]["recurrent"] < 30.0
        # A trial that passed is paid by the network's own share; all others keep theirs.
        passed, without = seconds[RecurrentTrial.PASSED], seconds[RecurrentTrial.NONE]
        trial = seconds[RecurrentTrial.RUNNING]["recurrent"]
        assert passed == pytest.approx(without | {"recurrent": without["recurrent"] - trial})
        failed = seconds[RecurrentTrial.FAILED]
        assert failed["recurrent"] == 0
        assert failed["trees"] >= without["trees"]


@pytest.mark.parametrize(("margin", "trained"), [(1e-9, ["trial"]), (1e9, ["recurrent", "trial"])])
def test_a_recurrent_network_is_trained_to_the_end_where_its_trial_comes_near_the_linear_model(
    tmp_path, monkeypatch, margin, trained
):
    monkeypatch.setattr("edp.workflows.auto.candidates.RECURRENT_ROWS", 1000)
    monkeypatch.setattr("edp.workflows.auto.train_candidates.MARGIN", margin)
    told = NotedProgress()
    source = write(tmp_path / "logs", ticks=1500)
    facts = train_auto(source, load_auto(None, SET), tmp_path / "run", told).choice.to_table()
    assert sorted(path.name for path in (tmp_path / "run" / "candidates").iterdir()) == trained
    assert list(facts["candidates"]) == ["linear", "committee", "recurrent"]
    assert any("short trial" in note for note in facts["notes"]) == (len(trained) == 1)
    count = 2 + len(trained)
    assert [stage for stage in told.stages if stage[0] == "model"] == [("model", 3), ("model", count)]
    assert len(told.notes) == count


def test_trees_of_many_outputs_keep_most_of_the_rows():
    """A budget goes into rows first, then into left-out parts, then into trees; more minutes never mean less."""
    amount = Amount(rows=31_000, shortest=1_000, features=12, outputs=24, horizon=10, minutes=5.0)
    plan = tree_plan(amount)
    assert plan.rows >= 15_000
    assert plan.rounds >= 40
    assert (plan.models, plan.folds) == (2, 2)
    assert 0.1 < plan.rate <= 0.2
    # Left-out trees have about as many rows as those in use, unless there is time for nothing else.
    for rows in (1_000, 11_000, 20_000, 31_000, 90_000):
        for minutes in (1.0, 3.0, 5.0):
            short = tree_plan(replace(amount, rows=rows, outputs=6, minutes=minutes))
            left = {5: 0.8, 3: 0.6, 2: 0.4}[short.folds] * rows
            assert short.rounds >= 40
            assert left >= 0.8 * min(short.rows, rows)
    little = tree_plan(replace(amount, rows=1_000, outputs=12, minutes=0.3))
    assert (little.folds, little.rounds >= 40) == (2, True)
    small = tree_plan(replace(amount, rows=1_000, outputs=3))
    assert (small.trees, small.models, small.folds, small.rate) == (300, 3, 5, 0.1)
    plans = [tree_plan(replace(amount, minutes=minutes)) for minutes in (0.01, 1.0, 5.0, 20.0, 200.0)]
    assert plans[0].trees == 0
    assert [one.rows for one in plans[1:]] == sorted(one.rows for one in plans[1:])
    assert (plans[-1].trees, plans[-1].folds, plans[-1].rows) == (300, 5, 60_000)


def test_many_channels_get_fewer_spans():
    amount = Amount(rows=60_000, shortest=60_000, features=12, outputs=2, horizon=10, minutes=5.0)
    wide = [spans_of(replace(amount, features=features)) for features in (12, 60, 100, 1000)]
    assert [len(one.lags) for one in wide] == [10, 6, 6, 3]
    assert [len(one.smoothed) for one in wide] == [4, 4, 0, 0]


def scores(network, **others):
    def model(errors):
        return {"overall": {"1": {name: {"rmse": value} for name, value in errors.items()}}, "label": "x"}

    table = {
        "task": {"horizons": [1]},
        "targets": [{"name": "a"}, {"name": "b"}],
        "models": {"network": model(network), **{name: model(errors) for name, errors in others.items()}},
    }
    return ScoresFile.from_table(table, "scores")


def test_the_guard_names_the_baseline_that_wins_and_where():
    network = {"a": 1.0, "b": 1.0}
    assert beaten_by(scores(network, ridge={"a": 1.1, "b": 1.0})) is None
    beaten = beaten_by(scores(network, ridge={"a": 0.9, "b": 1.0}, trees={"a": 0.5, "b": 1.5}))
    assert beaten is not None
    assert beaten.outputs == ("a",)
    assert 0.1 < beaten.less < 0.2
    assert "do not use" in beaten.sentence()
    assert beaten_by(scores(network)) is None
    assert beaten_by(scores(network, ridge={"a": 0.0, "b": 0.0})) is None
