"""``edp data screen`` and what it leaves, up to a training on the proposed set."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from edp.cli.console import Steps
from edp.cli.screen import ScreeningDisplay
from edp.config.experiment import load_experiment
from edp.logs.source import load_signal_map
from edp.training import TrainingProgress

QUICK = [
    word
    for change in (
        "max_lag=30",
        "pieces=6",
        "information_samples=400",
        "rank_samples=800",
        "segment_samples=200",
        "forest.trees=5",
        "forest.samples=800",
        "forest.tests=400",
        "forest.repeats=2",
    )
    for word in ("--set", f"screen.{change}")
]


def drive(path, seed, samples=2500, more=""):
    """A velocity that follows its command 8 samples later, a leak of it, a dead channel, noise and a text."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples + 40) / 100
    u = sum(np.sin(2 * np.pi * f * t + p) for f, p in zip(rng.uniform(0.2, 2.0, 8), rng.uniform(0, 6, 8)))
    v = np.zeros(len(t))
    for k in range(8, len(t)):
        v[k] = 0.9 * v[k - 1] + 2.0 * u[k - 8]
    v += rng.normal(0, 0.02, len(t))
    columns = [v[:samples], u[:samples], v[20 : samples + 20], rng.normal(size=samples), np.full(samples, 3.0)]
    rows = "\n".join(
        f"{k / 100:.2f}," + ",".join(f"{column[k]:.7g}" for column in columns) + ",ok" + (",1" if more else "")
        for k in range(samples)
    )
    path.write_text(f"t,speed [mm/s],lever,oracle,dice,dead,state{more}\n{rows}\n")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("screened") / "logs"
    folder.mkdir()
    for i in range(4):
        drive(folder / f"drive_{i}.csv", i, more=",extra" if i == 2 else "")
    return folder


def test_screen_proposes_and_a_training_uses_it(edp, logs, tmp_path, small):
    out = tmp_path / "screen"
    options = ["--horizon", "5", "--set", "screen.measured=['lever']", "--no-pictures"]
    ended = edp("data", "screen", logs, "--out", out, *options, *QUICK)
    assert ended.code == 0, ended.err
    assert "read: log 1 of 4, drive_0.csv" in ended.err
    assert "screen: " in ended.err
    assert "Only some recordings hold extra: left out." in ended.out
    assert "leak of the future" in ended.out
    assert "memory: W = " in ended.out
    assert f"next: edp train {logs} --map {out / 'map.toml'} --config {out / 'settings.toml'}" in ended.out

    found = json.loads((out / "screening.json").read_text())
    assert sorted(found["proposal"]["kept"]) == ["lever", "speed"]
    assert {"oracle", "dice", "dead"} <= set(found["proposal"]["dropped"])
    assert json.loads((out / "quality.json").read_text())["verdict"] == "check"
    proposed = (out / "sets" / "proposed.toml").read_text()
    assert "# dropped: oracle: leak of the future" in proposed
    assert sorted(tomllib.loads(proposed)["channels"]) == ["lever", "speed"]
    assert "oracle knows the future" in (out / "report.html").read_text(encoding="utf-8")
    assert not (out / "pictures").exists()
    kinds = {entry.name: str(entry.kind) for entry in load_signal_map(out / "map.toml").channels}
    assert kinds == {"speed": "velocity", "lever": "generic"}

    settings = ["--map", out / "map.toml", "--config", out / "settings.toml", "--out", tmp_path / "run"]
    trained = edp("train", logs, *settings, *small)
    assert trained.code == 0, trained.err
    kept = load_experiment(tmp_path / "run" / "config.toml", preset=None).task
    assert (kept.features.name, set(kept.features.channels), kept.horizons) == ("proposed", {"lever", "speed"}, (5,))

    lead = -min(curve["best"] for curve in found["lags"] if curve["channel"] == "lever")
    settings = ["--map", out / "map.toml", "--config", out / "settings_with_changes.toml", "--out", tmp_path / "second"]
    trained = edp("train", logs, *settings, *small)
    assert trained.code == 0, trained.err
    derived = load_experiment(tmp_path / "second" / "config.toml", preset=None).task.features.derived
    spans = {entry.source: round(entry.span_s * found["rate_hz"]) for entry in derived if entry.how == "change"}
    assert spans == {"lever": lead, "speed": 5}


def test_screen_tries_the_sets_and_draws(edp, logs, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "edp.workflows.feature_selection.select.write_screening_pictures", lambda found, folder: drawn.append(folder)
    )
    (tmp_path / "mine.toml").write_text('channels = ["speed", "dice"]')
    (tmp_path / "tiny.toml").write_text(
        "[training]\nepochs = 1\nupdates = 3\n"
        '[training.chunks]\nregime = "chunk"\nlength = 32\nbatch = 4\nburn_in = 10\n'
        '[model.backbone]\nkind = "lstm"\nunits = 4\n[evaluation]\nhistory = 5\n'
    )
    out = tmp_path / "screen"
    trials = [
        "--set",
        "screen.measured=['lever']",
        "--trials",
        "--set",
        "trials.random_sets=1",
        "--config",
        tmp_path / "tiny.toml",
        "--features",
        tmp_path / "mine.toml",
    ]
    monkeypatch.setattr("edp.cli.screen.Steps", lambda quiet: Steps(quiet, every_s=0.0))
    first = edp("data", "screen", logs, "--out", out, "--exclude", "oracle,dead", *QUICK, *trials)
    assert first.code == 0, first.err
    lines = [line for line in first.err.splitlines() if line.startswith("trials: ")]
    assert lines[0] == "trials: proposed, training 1 of 5, 0.0 %"
    assert any(line.startswith("trials: random 1, training 5 of 5, epoch 1/1, 100 %") for line in lines)
    assert not [line for line in lines if line.endswith(" 0.0 %, 0 s left")]
    assert "MAE, 10 ahead [mm/s]" in first.out
    table = [
        line.split()[0] for line in first.out.splitlines() if line.startswith(("proposed ", "mine ", "persistence "))
    ]
    assert table == ["proposed", "proposed", "mine", "persistence"]

    # What is trained already is not trained again.
    kept = (out / "trials" / "trials.json").read_bytes()
    ended = edp("data", "screen", logs, "--out", out, "--exclude", "oracle,dead", "--json", *QUICK, *trials)
    assert ended.code == 0, ended.err
    assert (out / "trials" / "trials.json").read_bytes() == kept
    facts = ended.json
    assert "oracle" not in facts["kept"] + facts["dropped"]
    names = [trial["name"] for trial in facts["trials"]["trials"]]
    assert names == ["proposed", "proposed + changes", "all candidates", "mine", "random 1"]
    assert drawn == [out / "pictures"] * 2
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Held-out errors of the sets" in page
    for trial in facts["trials"]["trials"]:
        assert trial["name"] in page
    assert facts["files"]["trials"] == str(out / "trials")


class Said:
    """Keeps what a display shows."""

    def __init__(self):
        self.lines = []

    def add_task(self, *_, **__):
        return len(self.lines)

    def update(self, *_, **__):
        pass

    def say(self, text):
        self.lines.append(text)


def test_time_left_is_told_once_there_is_something_to_judge_it_by(monkeypatch):
    now, said = [100.0], Said()
    monkeypatch.setattr("edp.cli.screen.time.monotonic", lambda: now[0])
    display = ScreeningDisplay(said, said)

    def tell(seconds, name, done, event=None):
        now[0] += seconds
        display.on_trial(name, done, 4, event)

    tell(0, "kept", 0)
    tell(0.1, "proposed", 1)
    tell(30, "proposed", 1, TrainingProgress(1, 2, 0, 10, 0.0, 0.0))
    tell(30, "proposed", 1, TrainingProgress(1, 2, 10, 10, 0.0, 0.0))
    tell(60, "proposed", 1, TrainingProgress(2, 2, 10, 10, 0.0, 0.0))
    tell(0, "proposed", 1, TrainingProgress(1, 2, 5, 10, 0.0, 0.0, refit=True))
    tell(60, "random 1", 2)
    assert said.lines == [
        "trials: kept, training 1 of 4, 0.0 %",
        "trials: proposed, training 2 of 4, 25 %",
        "trials: proposed, training 2 of 4, epoch 1/2, 25 %",
        "trials: proposed, training 2 of 4, epoch 1/2, 38 %, 5 min 00 s left",
        "trials: proposed, training 2 of 4, epoch 2/2, 50 %, 4 min 00 s left",
        "trials: proposed, training 2 of 4, epoch 1/2, 50 %, 4 min 00 s left",
        "trials: random 1, training 3 of 4, 50 %, 6 min 00 s left",
    ]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--targets", "sped"], "did you mean 'speed'"),
        (["--exclude", "levr"], "cannot exclude 'levr'"),
        (["--set", "screen.max_lags=3"], "unknown key 'screen.max_lags'; did you mean 'max_lag'"),
        (["--set", "max_lag=3"], "unknown key 'max_lag'; did you mean 'screen.max_lag'"),
        (["--set", "screen.forest.trees=0"], "1 <= trees <= 10,000 must hold"),
        (["--horizon", "200"], "beyond max_lag"),
        (["--set", "screen.max_lag"], "write key.path=value"),
    ],
)
def test_mistakes_are_told(edp, logs, tmp_path, args, says):
    ended = edp("data", "screen", logs, "--out", tmp_path / "x", "--no-pictures", *args)
    assert (ended.code, says in ended.err) == (1, True), ended.err
    assert not (tmp_path / "x" / "report.html").exists()
