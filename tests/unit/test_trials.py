"""Trials of feature sets: equal settings, the same held-out recordings, kept and gone on with."""

import json

import numpy as np
import pytest

from edp.config.experiment import FeatureSettings, load_experiment
from edp.data.features import Derived
from edp.errors import ConfigError
from edp.evaluation.trials_file import PairedDifference
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage import read_json
from edp.workflows.feature_selection.trials import (
    TrialSpec,
    _difference,
    _draw_sets,
    add_differences,
    try_feature_sets,
)

pytestmark = pytest.mark.processes

CHANNELS = (
    Channel("v", Kind.VELOCITY),
    Channel("u", Kind.RATIO),
    Channel("p", Kind.PRESSURE),
    Channel("noise", Kind.GENERIC),
    Channel("more", Kind.GENERIC),
)
SMALL = (
    'task.targets=["v"]',
    "task.horizons=[2, 5]",
    "training.epochs=1",
    "training.updates=4",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=16,batch=2,burn_in=5}',
    'model.backbone={kind="lstm",units=4}',
    'model.blocks=[{kind="linear_bypass", taps=4}]',
    "model.window=8",
    "evaluation.history=4",
    "split.test_fraction=0.4",
)
SETS = {
    "proposed": FeatureSettings(name="proposed", channels=("u",)),
    "all": "all",
    "FG1": "FG1",
    "blind": FeatureSettings(name="blind", channels=("v", "noise")),
}


def drive(name, seed, samples=260):
    rng = np.random.default_rng([seed, 7])
    u = np.repeat(rng.normal(size=samples // 13 + 1), 13)[:samples]
    v = np.zeros(samples)
    for t in range(2, samples):
        v[t] = 0.8 * v[t - 1] + 0.1 * u[t - 2]
    values = np.stack([v, u, 1e6 * v, *rng.normal(size=(2, samples))], axis=1)
    return Recording(name, CHANNELS, values.astype(np.float32), 100.0, source="test")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for i in range(7):
        write_recording(drive(f"drive_{i}", i), folder / "logs" / f"drive_{i}.parquet")
    kinds = {"v": "velocity", "u": "ratio", "p": "pressure", "noise": "generic", "more": "generic"}
    (folder / "map.toml").write_text("".join(f'[channels.{name}]\nkind = "{kind}"\n' for name, kind in kinds.items()))
    return DataSource.from_path(folder / "logs", folder / "map.toml")


@pytest.fixture(scope="module")
def experiment():
    return load_experiment(preset="quick", overrides=SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("trials") / "out"


@pytest.fixture(scope="module")
def trials(source, experiment, folder):
    told = []
    spec = TrialSpec(random_sets=1, seeds=(0, 1), excluded_channels=("u", "p"))
    found = try_feature_sets(source, experiment, SETS, folder, spec, lambda *facts: told.append(facts))
    assert [(name, done, total) for name, done, total, event in told if event is None] == [
        (name, 2 * n + seed, 8) for n, name in enumerate(["proposed", "all", "blind", "random 1"]) for seed in range(2)
    ]
    assert any(event is not None for *_, event in told)
    return found


def test_a_row_a_set_judged_on_the_same_recordings(trials):
    rows = {trial.name: trial for trial in trials.trials}
    assert list(rows) == ["proposed", "all", "blind", "random 1"]
    assert rows["proposed"].channels == ("v", "u")
    assert rows["all"].channels == tuple(channel.name for channel in CHANNELS)
    assert len(rows["random 1"].channels) == 2
    assert rows["random 1"].channels[0] == "v"
    assert rows["random 1"].channels[1] in {"noise", "more"}
    for trial in trials.trials:
        assert set(trial.error) == {"2", "5"}
        assert trial.error["2"] == pytest.approx(np.mean(trial.by_seed["2"]))
        assert trial.by_seed["2"][0] != trial.by_seed["2"][1]
    # The command is what tells of later velocities.
    assert rows["proposed"].error["5"] < 0.8 * rows["blind"].error["5"]
    assert rows["proposed"].difference is None
    assert rows["blind"].difference["5"].low > 0
    assert trials.persistence["5"] > rows["proposed"].error["5"]
    assert trials.unit == "mm/s"
    assert len(trials.held_out) >= 1


def test_what_could_not_be_tried_is_told(trials):
    assert trials.notes[0] == "proposed: v added, because mode = 'delta' needs the targets' present values"
    assert trials.notes[1].startswith("FG1 was not tried: the recordings lack CylVels_1, ")


def test_trials_are_kept(trials, source, experiment, folder):
    assert read_json(folder / "trials.json") == json.loads(json.dumps(trials.to_table()))
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*/history.jsonl")}
    assert len(before) == 8
    again = try_feature_sets(
        source, experiment, SETS, folder, TrialSpec(random_sets=1, seeds=(0, 1), excluded_channels=("u", "p"))
    )
    assert again.to_table() == trials.to_table()
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*/history.jsonl")} == before


def test_differences_are_paired():
    gap = _difference({"a": 3.0, "b": 6.0, "c": 9.0}, {"a": 2.0, "b": 5.0, "c": 8.0})
    assert gap == PairedDifference(1.0, 1.0, 1.0)
    assert _difference({"a": 1.0, "b": 3.0}, {"a": 1.0, "b": 1.0}).low < 0


def test_pressures_get_their_differences():
    settings = FeatureSettings(channels=("v", "p"), derived=(Derived("dv", "v"),))
    named = add_differences(settings, drive("d", 1), "with")
    assert named.derived == (Derived("dv", "v"), Derived("dp", "p", "difference", Kind.PRESSURE))
    assert add_differences(named, drive("d", 1), "with") == named


@pytest.mark.parametrize(
    ("channels", "asked", "found"),
    [(("v", "u"), 9, {"more", "noise", "p"}), (("v",), 2, set()), (("v", "u"), 0, set())],
)
def test_no_set_is_drawn_that_is_there_already(experiment, channels, asked, found):
    first = FeatureSettings(name="first", channels=channels)
    drawn = _draw_sets({"first": first}, experiment, drive("d", 1), TrialSpec(random_sets=asked))
    assert list(drawn) == [f"random {k + 1}" for k in range(len(found))]
    assert {tuple(one.channels) for one in drawn.values()} == {("v", name) for name in found}


def test_mistakes_are_told(source, experiment, tmp_path):
    with pytest.raises(ConfigError, match=r"there is no feature set 'FG3'.*FG"):
        try_feature_sets(source, experiment, {"x": "FG3"}, tmp_path)
    with pytest.raises(ConfigError, match="no feature set can be tried: FG1 was not tried"):
        try_feature_sets(source, experiment, {"FG1": "FG1"}, tmp_path)
    with pytest.raises(ConfigError, match="random_sets = -1"):
        TrialSpec(random_sets=-1)
