"""The main jobs as functions: data-set files, provenance, evaluation and footprints."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from noted_progress import NotedProgress

from edp.cli import app
from edp.cli.console import run_app
from edp.cli.evaluate import score_table
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared
from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.evaluation.scores_file import ScoresFile
from edp.jobs.workers import IN_PROCESS
from edp.logs import open_log, read_recording, write_recording
from edp.logs.repair import Repair
from edp.networks.running import stream_intervals
from edp.recording import Recording
from edp.signals import EXTRA_CHANNELS, TABLE_A1, Channel, Kind, SignalMap
from edp.training import Diverged, load_bundle
from edp.training.objective import Objective
from edp.workflows.deployment import footprint_of
from edp.workflows.train_evaluate import (
    DataSource,
    SimulationOrder,
    build_report,
    evaluate,
    judge_bundle,
    prepare_data,
    simulate_data_set,
    train,
)

pytestmark = pytest.mark.processes

CHANNELS = (Channel("v", Kind.VELOCITY), Channel("u", Kind.RATIO))
SMALL = (
    'task.features={name="rig", channels=["v", "u"]}',
    'task.targets=["v"]',
    "task.horizons=[2]",
    "training.epochs=1",
    "training.updates=3",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=16,batch=2,burn_in=5}',
    'model.backbone={kind="lstm",units=4}',
    "model.blocks=[]",
    "model.window=8",
    "evaluation.history=4",
    'evaluation.baselines=["persistence"]',
)


def drive(name, seed, samples=200, rate_hz=100.0):
    rng = np.random.default_rng([seed, samples])
    u = np.sin(np.arange(samples) / 15 + rng.uniform(0, 6)) + 0.01 * rng.normal(size=samples)
    values = np.stack([np.convolve(u, np.ones(5) / 5)[:samples], u], axis=1)
    return Recording(name, CHANNELS, values.astype(np.float32), rate_hz, source="test")


@pytest.fixture
def logs(tmp_path):
    """Four drives, and the map that names their columns."""
    for i in range(4):
        write_recording(drive(f"drive_{i}", i), tmp_path / "logs" / f"drive_{i}.csv")
    lines = ['[channels.v]\nkind = "velocity"\nunit = "m/s"', '[channels.u]\nkind = "ratio"\nunit = "1"']
    (tmp_path / "map.toml").write_text("\n".join(lines) + "\n")
    return tmp_path / "logs"


def experiment():
    return load_experiment(preset="quick", overrides=SMALL)


def source_of(logs):
    return DataSource.from_path(logs, logs.parent / "map.toml")


def listed(logs, *entries, head='map = "map.toml"\n'):
    path = logs.parent / "set.toml"
    path.write_text(head + "".join(f"[[recordings]]\n{entry}\n" for entry in entries))
    return path


def test_a_data_set_file_says_which_machine_a_log_is_of(logs):
    entries = [f'path = "{path.name}"\nmachine = "Digger {i}"' for i, path in enumerate(sorted(logs.glob("*.csv"))[:2])]
    found = DataSource.from_path(
        listed(logs, *[entry.replace('path = "', f'path = "{logs.name}/') for entry in entries])
    ).read()
    assert [recording.meta["machine"] for recording in found] == ["Digger 0", "Digger 1"]


def test_a_run_holds_all_that_repeats_it(logs, tmp_path):
    bundle = train(source_of(logs), experiment(), tmp_path / "run")
    facts = json.loads((tmp_path / "run" / "provenance.json").read_text())
    parts = [facts["data"][part]["names"] for part in ("train", "validation", "test")]
    assert sorted(name for names in parts for name in names) == ["drive_0", "drive_1", "drive_2", "drive_3"]
    assert facts["environment"]["torch"] == str(torch.__version__)
    again = DataSource.from_dict(facts["data"]["reader"])
    kept = load_experiment(tmp_path / "run" / "config.toml", "standard")
    assert prepare_data(again, kept).digest == facts["data"]["digest"]
    held = load_bundle(tmp_path / "run")
    assert [channel.name for channel in held.inputs] == ["v", "u"]
    assert all(torch.equal(a, b) for a, b in zip(bundle.predictor.parameters(), held.predictor.parameters()))


def test_the_same_settings_and_data_give_the_same_bits(logs, tmp_path):
    first = train(source_of(logs), experiment(), tmp_path / "a").predictor
    second = train(source_of(logs), experiment(), tmp_path / "b").predictor
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters()))


def test_evaluation_writes_scores_here_and_into_the_bundle(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    assert load_bundle(tmp_path / "run").scores == {}
    told = NotedProgress()
    steps = told.notes
    assert evaluate(tmp_path / "run", progress=told) == tmp_path / "run"
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    assert steps == ["network", "persistence"]
    assert set(scores["models"]) == {"network", "persistence"}
    assert load_bundle(tmp_path / "run").scores == scores["models"]["network"]["overall"]


def _contents(run):
    """Bytes of every file but the lock, which holds the second at which it was taken."""
    return {path.name: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != ".lock"}


def test_a_run_that_diverged_says_so_again_and_keeps_what_was_good(logs, tmp_path, monkeypatch):
    run, real, calls = tmp_path / "run", Objective.evaluate, []

    def evaluate_(self, *parts):
        calls.append(1)
        return real(self, *parts) * (np.nan if len(calls) == 5 else 1.0)

    monkeypatch.setattr(Objective, "evaluate", evaluate_)
    changed = load_experiment(preset="quick", overrides=[*SMALL, "training.epochs=4"])
    with pytest.raises(Diverged, match=r"loss is nan at update 5 \(epoch 2\).*weights of epoch 1 .* are kept"):
        train(source_of(logs), changed, run)
    status = json.loads((run / "status.json").read_text())
    assert (status["status"], status["epoch"], status["update"], status["kept_epoch"]) == ("diverged", 2, 5, 1)
    assert len((run / "history.jsonl").read_text().splitlines()) == 1
    kept = load_bundle(run)
    assert "the training diverged" in kept.provenance.more["diverged"]
    bits = _contents(run)
    with pytest.raises(
        Diverged, match=r"diverged on 20.*nan at update 5.*would do so again.*another folder with --out"
    ):
        train(source_of(logs), changed, run)
    assert _contents(run) == bits
    evaluate(run)


def test_an_absurd_learning_rate_diverges_with_nothing_to_keep(logs, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    options = [*SMALL, "training.optimizer.learning_rate=1e38", 'training.schedule={kind="constant"}']
    words = ["edp", "train", str(logs), "--map", str(logs.parent / "map.toml"), "--preset", "quick", "--out", str(run)]
    monkeypatch.setattr(sys, "argv", [*words, *(word for option in options for word in ("--set", option))])
    for _ in range(2):
        assert run_app(app) == 4
        assert "the training diverged; no epoch was finished before" in capsys.readouterr().err
    assert json.loads((run / "status.json").read_text())["status"] == "diverged"
    assert not (run / "bundle").exists()


def test_a_finished_run_says_so(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    assert json.loads((tmp_path / "run" / "status.json").read_text())["status"] == "finished"


def test_contradictory_settings_are_refused_before_anything_is_written(logs, tmp_path):
    changed = load_experiment(preset="quick", overrides=[*SMALL, 'training.loss={kind="quantile"}'])
    with pytest.raises(ConfigError, match=r"'quantile' trains the output 'quantiles', but model.output is 'point'"):
        train(source_of(logs), changed, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("output", ["quantiles", "normal", "laplace"])
def test_intervals_are_judged_and_shown(output, logs, tmp_path, capsys):
    loss = "quantile" if output == "quantiles" else "heteroscedastic"
    kinds = [f'model.output={{kind="{output}"}}', f'training.loss={{kind="{loss}"}}']
    bundle = train(source_of(logs), load_experiment(preset="quick", overrides=[*SMALL, *kinds]), tmp_path / "run")
    evaluate(tmp_path / "run")
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    rows = scores["models"]["network"]["intervals"]["2"]
    assert [row["coverage"] for row in rows] == [0.9, 0.5]
    # The same by hand, from bounds in SI units.
    data = prepare_data(source_of(logs), load_experiment(tmp_path / "run" / "config.toml", preset=None))
    inside, width, outside = [], [], []
    for part, bounds in zip(data.test, stream_intervals(bundle.predictor, data.test), strict=True):
        truth = part.targets[2 + 8 :]
        lower, upper = bounds[8 : part.samples - 2, 0, :, 0].transpose(1, 0, 2)
        inside.append((lower <= truth) & (truth <= upper))
        width.append(1000 * (upper - lower))
        outside.append((1000 * np.maximum(lower - truth, 0.0), 1000 * np.maximum(truth - upper, 0.0)))
    assert rows[0]["covered"]["v"] == rows[0]["covered"]["mean"] == pytest.approx(np.concatenate(inside).mean())
    assert rows[0]["width"]["v"] == pytest.approx(np.concatenate(width).mean(), rel=1e-5)
    below, above = (np.concatenate(parts) for parts in zip(*outside, strict=True))
    assert rows[0]["score"]["v"] == pytest.approx((np.concatenate(width) + 20.0 * (below + above)).mean(), rel=1e-5)
    mae = scores["models"]["network"]["overall"]["2"]["v"]["mae"]
    weighted = 0.5 * mae + sum(0.5 * (1 - row["coverage"]) * row["score"]["v"] for row in rows)
    assert scores["models"]["network"]["weighted_interval_score"]["2"]["v"] == pytest.approx(weighted / 2.5)
    score_table(ScoresFile.read(tmp_path / "run"))
    assert "meant" in capsys.readouterr().out
    page = build_report(tmp_path / "run").read_text(encoding="utf-8")
    assert "Meant to hold" in page
    assert "% interval" in page.split('id="figures">')[1]  # drawn, too


def test_the_same_judgement_is_not_made_twice(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    told = NotedProgress()
    steps = told.notes
    evaluate(tmp_path / "run", progress=told)
    scores = (tmp_path / "run" / "scores.json").read_bytes()
    train(source_of(logs), experiment(), tmp_path / "run")
    evaluate(tmp_path / "run", progress=told)
    assert steps == ["network", "persistence"]
    assert (tmp_path / "run" / "scores.json").read_bytes() == scores
    assert load_bundle(tmp_path / "run").scores == json.loads(scores)["models"]["network"]["overall"]
    evaluate(tmp_path / "run", baselines=["ridge_arx"], progress=told)
    assert steps[2:] == ["network", "ridge_arx"]


def test_cheap_baselines_come_first_and_a_budget_leaves_out_the_others(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    told = NotedProgress()
    steps = told.notes
    names = ["small_mlp", "ridge_arx", "persistence"]
    evaluate(tmp_path / "run", baselines=names, progress=told, minutes=0.0)
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    assert "small_mlp" in scores["left_out"]
    assert "small_mlp" not in scores["models"]
    steps.clear()
    evaluate(tmp_path / "run", baselines=names, progress=told)
    assert steps == ["network", "persistence", "ridge_arx", "small_mlp"]
    assert "left_out" not in json.loads((tmp_path / "run" / "scores.json").read_text())


def test_evaluation_on_other_recordings_leaves_the_run_as_it_was(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    header = (tmp_path / "run" / "bundle" / "bundle.json").read_bytes()
    other = tmp_path / "other.csv"
    write_recording(drive("other", 9), other)
    folder = evaluate(tmp_path / "run", DataSource.from_path(other, tmp_path / "map.toml"))
    assert folder == tmp_path / "run" / "on_other"
    assert (folder / "predictions.safetensors").is_file()
    assert not (tmp_path / "run" / "scores.json").exists()
    assert (tmp_path / "run" / "bundle" / "bundle.json").read_bytes() == header


def test_a_bundle_alone_is_not_a_run(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    with pytest.raises(StorageError, match="not a run folder"):
        evaluate(tmp_path / "run" / "bundle")


def test_a_bundle_is_judged_without_a_run_folder(logs, tmp_path):
    bundle = train(source_of(logs), experiment(), tmp_path / "run")
    data = prepare_data(source_of(logs), experiment())
    assert isinstance(data, Prepared)
    found = judge_bundle(bundle, data, experiment().evaluation)
    assert found.scores.models["network"].overall["2"]["mean"]["mae"] > 0


def test_data_set_files_give_parts_names_and_maps(logs):
    own = 'path = "logs/drive_1.csv"\nname = "second"\n[recordings.map.channels.u]\nkind = "ratio"\nunit = "%"'
    path = listed(logs, 'path = "logs/drive_0.csv"\nrows = [20, 70]', own)
    first, second = DataSource.from_path(path).read()
    assert (first.name, first.samples, first.channel_names) == ("drive_0", 50, ("v", "u"))
    assert (second.name, second.channel_names) == ("second", ("u",))
    np.testing.assert_allclose(100 * second.column("u"), drive("", 1).column("u"), rtol=1e-6)


def test_names_and_rates_of_data_set_files_must_agree(logs):
    path = listed(logs, 'path = "logs/drive_0.csv"', 'path = "logs/drive_0.csv"')
    with pytest.raises(DataError, match="drive_0 occur twice"):
        DataSource.from_path(path).read()
    write_recording(drive("slow", 5, rate_hz=50.0), logs / "slow.csv")
    path = listed(logs, 'path = "logs/drive_0.csv"', 'path = "logs/slow.csv"')
    with pytest.raises(DataError, match=r"mixed rates.*100 Hz.*50 Hz.*rate_hz"):
        DataSource.from_path(path).read()


def test_repairs_of_the_call_replace_those_of_the_file(logs):
    log = logs / "drive_0.csv"
    lines = log.read_text().splitlines()
    lines[30] = lines[30].rpartition(",")[0] + ","
    log.write_text("\n".join(lines) + "\n")
    path = listed(logs, 'path = "logs/drive_0.csv"')
    with pytest.raises(DataError, match="missing or infinite"):
        DataSource.from_path(path).read()
    (mended,) = DataSource.from_path(path, repair=Repair(nan="hold")).read()
    assert np.isfinite(mended.values).all()
    held = listed(logs, 'path = "logs/drive_0.csv"', head='map = "map.toml"\nrepair = { nan = "hold" }\n')
    assert DataSource.from_path(held).read()[0].digest == mended.digest


@pytest.mark.parametrize(("layout", "variable"), [("simulink", "logsout"), ("speedgoat", "data")])
def test_simulated_data_sets_in_layouts_of_others_read_back_without_truth(tmp_path, layout, variable):
    order = SimulationOrder(minutes=0.1, recordings=1, seed=1, suffix=".mat", layout=layout)
    (path,) = simulate_data_set(tmp_path, order, IN_PROCESS)
    assert {"CylVels_1", "BmUp"} <= set(open_log(path, SignalMap(variable=variable)).signals)
    (read,) = DataSource.from_path(tmp_path).read()
    assert (read.channel_names, read.rate_hz) == (tuple(TABLE_A1), 100.0)
    with pytest.raises(StorageError, match="another simulated data set"):
        simulate_data_set(tmp_path, replace(order, layout="struct"), IN_PROCESS)
    truth = read_recording(path, SignalMap(variable="truth"))
    assert set(truth.channel_names) == set(EXTRA_CHANNELS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": "simulnk", "suffix": ".mat"}, "did you mean 'simulink'"),
        ({"layout": "simulink"}, "is one of MAT files"),
        ({"truth": "beside"}, "truth = 'beside'"),
        ({"suffix": ".mta"}, "no log format"),
    ],
)
def test_orders_for_files_that_cannot_be_are_refused_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(EdpError, match=message):
        simulate_data_set(tmp_path / "data", SimulationOrder(**change), IN_PROCESS)
    assert not (tmp_path / "data").exists()


def test_simulated_data_sets_go_on_and_refuse_another_plan(tmp_path):
    seen = []

    def on_done(recording, kept):
        seen.append((recording.name, kept))

    order = SimulationOrder(minutes=0.3, recordings=2, seed=1)
    paths = simulate_data_set(tmp_path, order, IN_PROCESS, on_done)
    held = [path.read_bytes() for path in paths]
    paths[0].unlink()
    assert simulate_data_set(tmp_path, order, IN_PROCESS, on_done) == paths
    assert [path.read_bytes() for path in paths] == held
    assert [kept for _, kept in seen] == [False, False, True, False]
    with pytest.raises(StorageError, match="another simulated data set"):
        simulate_data_set(tmp_path, replace(order, seed=2), IN_PROCESS)


def test_footprints_of_settings_runs_and_bundles_agree(logs, tmp_path):
    train(source_of(logs), experiment(), tmp_path / "run")
    counts, _ = footprint_of(tmp_path / "run" / "config.toml")
    assert footprint_of(tmp_path / "run")[0] == counts
    assert footprint_of(tmp_path / "run" / "bundle")[0] == counts
    with pytest.raises(EdpError, match="not a bundle"):
        footprint_of(logs)
