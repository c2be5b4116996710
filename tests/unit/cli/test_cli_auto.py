"""``edp train`` without a preset, and the guard of ``edp evaluate``."""

import json
import tomllib

import numpy as np
import pytest

from edp.cli.evaluate import baseline_names
from edp.evaluation.baselines import BASELINES
from edp.storage import write_json

SETTINGS = ("--set", "task.targets=['CylVels_1']", "--set", "task.horizons=[5]", "--time-budget", "0.01min")


def test_train_says_what_it_chose_and_why(edp, logs, tmp_path):
    run = tmp_path / "run"
    ended = edp("train", logs, "--out", run, *SETTINGS)
    assert ended.code == 0, ended.err
    assert "is kept" in ended.out
    assert "error on left-out data" in ended.out
    assert "the linear model" in ended.out
    facts = json.loads((run / "auto.json").read_text())
    assert facts["minutes"] == 0.01
    again = edp("train", logs, "--out", run, *SETTINGS, "--json")
    assert again.json["sentence"] == facts["sentence"]
    chunks = edp("compress", "distil", run, "--units", "4", "--out", tmp_path / "small", "--set", "training.epochs=3")
    assert chunks.code == 1
    reasons = {"linear": "has no width", "committee": "training.epochs: the student of a committee learns on rows"}
    assert reasons[facts["chosen"]] in chunks.err


def test_settings_of_a_network_take_the_preset_standard(edp, logs, tmp_path, small):
    run = tmp_path / "run"
    assert small[:2] == ["--preset", "quick"]
    assert edp("train", logs, "--out", run, *small[2:]).code == 0
    assert "units = 6" in (run / "config.toml").read_text()
    assert not (run / "auto.json").exists()


def test_minutes_are_of_the_preset_auto_alone(edp, logs, tmp_path):
    ended = edp("train", logs, "--out", tmp_path / "run", "--preset", "quick", "--time-budget", "3min")
    assert ended.code == 1
    assert "--time-budget: it has no effect without the preset auto" in ended.err
    assert not (tmp_path / "run").exists()


def test_a_network_that_loses_says_so_first_and_by_its_exit_code(edp, trained):
    few = ("evaluate", trained, "--baselines", "persistence")
    edp(*few)
    file = trained / "scores.json"
    scores = json.loads(file.read_text())
    for model, factor in (("network", 2.0), ("persistence", 1.0)):
        for targets in scores["models"][model]["overall"].values():
            for metrics in targets.values():
                metrics["rmse"] = factor
    write_json(file, scores)
    lost = edp(*few)
    assert lost.code == 6
    assert lost.out.startswith("On the held-out recordings Persistence has 50 % less error")
    assert edp(*few, "--json").json["beaten_by"] == "Persistence"
    for targets in scores["models"]["network"]["overall"].values():
        for metrics in targets.values():
            metrics["rmse"] = 0.5
    write_json(file, scores)
    won = edp(*few)
    assert won.code == 0
    assert "less error than the network" not in won.out


def log(folder, ticks, u=None, y=None):
    """A CSV with a lever and what follows it, and its map; the options that name both."""
    steps = np.repeat(np.random.default_rng(0).uniform(-1, 1, ticks // 10 + 1), 10)[:ticks]
    u = steps if u is None else np.full(ticks, u)
    y = np.convolve(steps, 0.9 ** np.arange(40))[:ticks] if y is None else np.full(ticks, y)
    rows = "".join(f"{tick / 50:.3f},{a:.6f},{b:.6f}\n" for tick, (a, b) in enumerate(zip(u, y, strict=True)))
    (folder / "log.csv").write_text("time,u,y\n" + rows)
    (folder / "map.toml").write_text('time = "time"\n[channels.u]\ncolumn = "u"\n[channels.y]\ncolumn = "y"\n')
    return folder / "log.csv", "--map", folder / "map.toml", "--time-budget", "0.001min", "--set", "task.targets=['y']"


BLIND = ("task.features={name='lever', channels=['u']}", "task.mode='absolute'")


@pytest.mark.parametrize(
    ("ticks", "values", "settings", "words"),
    [
        (900, {"y": 2.0}, (), ("target y never moves", "take it out of task.targets")),
        (900, {"y": 0.0}, (), ("target y never moves", "record it while the machine works")),
        (900, {"u": 3e7}, BLIND, ("no input moves", "check the signal map")),
        (900, {}, ("task.horizons=[190]",), ("too short", "shorter horizon")),
        (900, {}, ("task.horizons=[90]",), ("longer than the largest horizon of 90 ticks", "shorter horizon")),
        (9, {}, (), ("log", "too short (9 samples)", "give a longer recording")),
        (40, {}, ("task.horizons=[1]",), ("1 independent block(s)", "two must hold", "longer or more recordings")),
        (80, {}, ("task.horizons=[1]",), ("54 rows for 5 folds", "record longer")),
        (900, {}, ("split={kind='recordings', test=['log']}",), ("no recording is left for train", "split by time")),
    ],
)
def test_data_that_hold_nothing_to_learn_are_one_error(edp, tmp_path, ticks, values, settings, words):
    options = [word for setting in settings for word in ("--set", setting)]
    ended = edp("train", *log(tmp_path, ticks, **values), "--out", tmp_path / "run", *options)
    text = " ".join(ended.err.split())
    assert ended.code == 1, text
    assert "Traceback" not in text
    assert text.count("error:") == 1
    for word in words:
        assert word in text
    assert not (tmp_path / "run" / "run.json").exists()


def test_one_recording_is_divided_by_time(edp, tmp_path):
    ended = edp("train", *log(tmp_path, 900), "--out", tmp_path / "run", "--set", "task.horizons=[2]")
    assert ended.code == 0, ended.err
    split = tomllib.loads((tmp_path / "run" / "config.toml").read_text())["split"]
    assert split == {"kind": "time", "validation_fraction": 0.15, "test_fraction": 0.2, "train_short_recordings": False}


@pytest.mark.parametrize(
    ("text", "names"),
    [("all", list(BASELINES)), ("none", []), ("", []), ("persistence, ridge_arx", ["persistence", "ridge_arx"])],
)
def test_baselines_are_named_or_all_or_none(text, names):
    assert baseline_names(text) == names
