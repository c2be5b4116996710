import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import load_experiment, read_toml
from edp.errors import ConfigError
from edp.logs.source import load_data_set
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage import read_json
from edp.workflows.auto import load_auto, train_auto
from edp.workflows.train_evaluate import DataSource, evaluate, train

ROOT = Path(__file__).parents[2]
REAL = ROOT / "examples" / "real"
LISTED = read_toml(REAL / "leagues.toml")
ENTRIES = [*LISTED["floors"], *LISTED["leagues"]]


def script(name):
    """A benchmark script as a module."""
    spec = importlib.util.spec_from_file_location(f"bench_{name}", ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scripts():
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    try:
        names = ("auto_preset", "transfer_real", "twin_leagues", "twin_recordings")
        yield {name: script(name) for name in names}
    finally:
        sys.path.remove(folder)


@pytest.mark.parametrize("entry", ENTRIES, ids=[entry["settings"] for entry in ENTRIES])
def test_maps_and_settings_agree(entry):
    data = load_data_set(REAL / entry["data"])
    maps = [recording.map or data.map for recording in data.recordings]
    experiment = load_experiment(REAL / entry["settings"], "small")
    task = experiment.task.resolve(10.0)
    for signal_map in maps:
        assert set(task.features.inputs) <= {channel.name for channel in signal_map.channels}
    if "rows" in entry:
        assert {row[0] for row in entry["rows"]} <= set(task.targets)
        assert {row[1] for row in entry["rows"]} <= set(task.horizons)
        assert all(linear > 0 and persistence > 0 for _, _, persistence, linear in entry["rows"])
    else:
        assert task.horizons == (0,)
        assert not set(task.targets) & set(task.features.lasting)
        assert set(entry["rivals"]) <= set(entry["published"])
        assert entry["target"] in task.targets


def test_every_file_is_listed():
    named = {entry["settings"] for entry in ENTRIES} | {entry["data"] for entry in ENTRIES} | {"leagues.toml"}
    assert {path.name for path in REAL.iterdir()} == named


def test_sets_share_one_preset():
    for path in REAL.glob("*_settings.toml"):
        free_run = path.name.endswith("_freerun_settings.toml")
        # A league is a contest: each has settings of its own. What is held against floors differs in the task alone.
        assert free_run or set(read_toml(path)) <= {"task", "split"}, f"{path.name} changes more than task and split"


def test_an_unset_variable_is_named(monkeypatch):
    monkeypatch.delenv("EDP_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match=r"EDP_SHARED_DATA.*is not set"):
        DataSource.from_path(REAL / "faster.toml").read()


@pytest.mark.parametrize("name", ["auto_preset", "transfer_real", "twin_leagues", "twin_recordings"])
def test_without_recordings_it_says_so_and_succeeds(name, scripts, tmp_path, capsys):
    scripts[name].main(["--shared", str(tmp_path / "nowhere")])
    lines = capsys.readouterr().out.strip().splitlines()
    assert lines[0].startswith("skipped:")
    assert json.loads(lines[-1])["skipped"] is True


def test_a_set_becomes_a_machine_with_one_actuator(scripts):
    twins = scripts["twin_leagues"]
    assert set(twins.SETS) == {entry["data"] for entry in LISTED["leagues"]}
    rng = np.random.default_rng(0)
    stroke = np.cumsum(rng.normal(size=200)).astype(np.float32)
    values = np.stack([rng.normal(size=200), stroke, rng.normal(size=200)], axis=1).astype(np.float32)
    names = [(Kind.GENERIC, name) for name in ("u", "x", "p")]
    recording = Recording("log", tuple(Channel(name, kind) for kind, name in names), values, 2.0, "here")
    pressure = twins.machine(recording, twins.SETS["sjoberg.toml"])
    assert pressure.channel_names == ("command", "velocity")
    assert np.array_equal(pressure.column("velocity"), values[:, 2])
    made = twins.machine(recording, replace(twins.SETS["emps.toml"], stroke="x"))
    assert made.channel_names == ("command", "velocity", "stroke")
    np.testing.assert_allclose(made.column("velocity")[1:], 2.0 * np.diff(stroke), rtol=1e-4)
    assert made.column("velocity")[0] == 0
    channels = twins.twin_channels(made)
    assert [c.name for c in channels.answers] == ["velocity", "stroke"]
    part = channels.task().series(made)
    floor = twins.TWINS["arx"](lags=2, prefix_ticks=10)
    twin = floor.start(channels, twins.fit_scales(channels, [part]), [part], 0)
    state = twin.reset(part.inputs[None, :10], part.targets[None, :10])
    answers = twin.rollout(part.inputs[None, 10:-1], state)[0][0, :, 1]
    expected = np.sqrt(np.mean((answers - part.targets[11:, 1]) ** 2))
    assert twins.free_run_rmse(twin, part, "stroke") == pytest.approx(expected, rel=1e-5)


def test_a_narx_rival_follows_a_quadratic_system_through_a_run_that_it_was_not_fitted_to(scripts):
    rng = np.random.default_rng(0)
    command, answer = np.repeat(rng.uniform(-1, 1, 80), 10), np.zeros(800)
    for t in range(1, 800):
        answer[t] = 0.8 * answer[t - 1] + 0.2 * command[t - 1] ** 2 - 0.1 * command[t - 1]
    fit_narx = scripts["twin_leagues"].fit_narx
    rival = fit_narx(command[:600, None], answer[:600], 10, 0)
    said = rival.free_run(command[600:, None], answer[600:])
    assert np.sqrt(np.mean((said - answer[600 + rival.lags :]) ** 2)) < 0.02 * np.std(answer)


def test_the_default_twin_is_held_against_the_best_of_its_rivals(scripts):
    twins = scripts["twin_recordings"]
    assert set(twins.SETS) <= {path.stem for path in REAL.glob("*.toml")}
    values = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    recording = Recording("log", (Channel("a", Kind.GENERIC), Channel("b", Kind.GENERIC)), values, 2.0, "here")
    turned = twins.machine(recording, twins.MachineSet(("a",), ("b",), turning=True))
    assert [(c.name, c.kind) for c in turned.channels] == [("a", Kind.RATIO), ("b", Kind.ANGLE)]
    errors = {"twin": 0.4, "static": 1.0, "arx": 0.5, "n4sid": 2.0}
    row = {"errors": errors, "diverged": dict.fromkeys(errors, 0.0), "chosen": "x", "promise": 0.5, "processor_s": 1.0}
    first, second, mean = twins.show({"one": row, "two": row | {"errors": errors | {"twin": 0.6}}}, quick=True)
    assert (first.is_met, second.is_met) == (True, False)
    assert (first.ratio, second.ratio) == (pytest.approx(0.8), pytest.approx(1.2))
    assert mean.ratio == pytest.approx(np.sqrt(0.8 * 1.2))


def test_real_recordings_train_through_their_maps(tmp_path, monkeypatch):
    """The whole path on a set of the same shape, so that it runs where the recordings are not."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(160, 2)), 8, axis=0)[:1024]
    y = np.zeros_like(u)
    for t in range(1, len(u)):
        y[t] = 0.9 * y[t - 1] + 0.1 * np.tanh(u[t - 1]) + 0.01 * rng.normal(size=2)
    (tmp_path / "cascaded_tanks").mkdir()
    table = np.column_stack([u, y])
    text = "uEst,uVal,yEst,yVal\n" + "\n".join(",".join(f"{v:.6g}" for v in row) for row in table)
    (tmp_path / "cascaded_tanks/dataBenchmark.csv").write_text(text)
    monkeypatch.setenv("EDP_SHARED_DATA", str(tmp_path))
    data = DataSource.from_path(REAL / "tanks.toml")
    changes = ["training.epochs=1", "training.updates=2"]
    train(data, load_experiment(REAL / "tanks_freerun_settings.toml", "small", changes), tmp_path / "free")
    assert np.isfinite(rmse(tmp_path / "free", "network", 0))
    train_auto(data, load_auto(REAL / "tanks_settings.toml", ["auto.time_budget_min=0.05"]), tmp_path / "run")
    for horizon in (1, 5, 10):
        assert rmse(tmp_path / "run", "network", horizon) < rmse(tmp_path / "run", "persistence", horizon)


def rmse(run: Path, model: str, horizon: int) -> float:
    scores = read_json(evaluate(run, baselines=("persistence", "ridge_arx")) / "scores.json")
    return scores["models"][model]["overall"][str(horizon)]["y"]["rmse"]
