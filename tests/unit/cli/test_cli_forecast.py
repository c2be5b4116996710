"""``edp data add-forecasts``: logs with forecasts as channels, and a network that reads them."""

from dataclasses import replace

import numpy as np
import pytest

from edp.config.twin import load_twin_experiment
from edp.logs import read_recording, write_recording
from edp.logs.source import DataSource
from edp.testing.twins import sample_actuators
from edp.workflows.twin import train_twin

TASK = ("task.features=all", "task.targets=['speed_1']", "task.horizons=[4]")
NETWORK = ("training.updates=3", "training.epochs=1", "model.window=10")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("actuators")
    for seed in range(4):
        write_recording(sample_actuators(seed=seed), folder / f"log_{seed}.parquet")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, logs):
    folder = tmp_path_factory.mktemp("twins") / "run"
    settings = ("twin.kind=arx", "evaluation.duration_s=4", "evaluation.starts=2", "evaluation.at_s=[1, 4]")
    train_twin(DataSource.from_path(logs), load_twin_experiment(None, settings), folder)
    return folder


def test_logs_get_a_channel_for_each_forecast(edp, run, logs, tmp_path):
    ended = edp(
        "data", "add-forecasts", run, logs, "--out", tmp_path / "ahead", "--horizon", "1", "--ahead", "4", "--json"
    )
    assert ended.code == 0
    names = [f"speed_{which}_in_{k}" for k in (1, 4) for which in (1, 2)]
    assert ended.json["channels"] == names
    assert ended.json["logs"] == 4
    before, after = (
        read_recording(logs / "log_2.parquet"),
        read_recording(tmp_path / "ahead" / "0003_actuators_2.parquet"),
    )
    assert after.channel_names == (*before.channel_names, *names)
    np.testing.assert_array_equal(after.values[:, : len(before.channels)], before.values)
    assert np.isfinite(after.values).all()
    assert [after.channels[after.index(name)].kind for name in names] == [
        before.channels[before.index(name[: len("speed_1")])].kind for name in names
    ]
    # A forecast of the velocity one tick ahead is near it.
    truth = before.column("speed_1")
    far = np.abs(after.column("speed_1_in_1")[100:-1] - truth[101:]).mean()
    assert far < 0.5 * np.abs(truth - truth.mean()).mean()
    row = ended.json["ahead"]["4"]
    assert row["twin"]["by_channel"].keys() == {"speed_1", "speed_2"}
    counted = sum(read_recording(path).samples for path in logs.glob("*.parquet"))
    assert 0 < row["moments"] < counted
    shown = edp("data", "add-forecasts", run, logs, "--out", tmp_path / "again").out
    assert "present value held" in shown
    assert "next: edp train" in " ".join(shown.split())


def test_a_network_trains_on_forecasts(edp, run, logs, tmp_path):
    assert edp("data", "add-forecasts", run, logs, "--out", tmp_path / "ahead", "--horizon", "4").code == 0
    words = [word for change in (*TASK, *NETWORK) for word in ("--set", change)]
    ended = edp("train", tmp_path / "ahead", "--preset", "quick", "--out", tmp_path / "run", *words)
    assert ended.code == 0
    assert '"speed_1_in_4"' in (tmp_path / "run" / "bundle" / "bundle.json").read_text()


def test_a_folder_in_use_a_channel_of_that_name_and_one_that_is_not_answered_are_refused(edp, run, logs, tmp_path):
    used = tmp_path / "used"
    used.mkdir()
    (used / "mine.txt").write_text("keep")
    ended = edp("data", "add-forecasts", run, logs, "--out", used)
    assert ended.code == 1
    assert "holds something already" in " ".join(ended.err.split())
    assert [path.name for path in used.iterdir()] == ["mine.txt"]
    assert edp("data", "add-forecasts", run, logs, "--out", tmp_path / "once").code == 0
    twice = edp("data", "add-forecasts", run, tmp_path / "once", "--out", tmp_path / "twice")
    assert "has a channel 'speed_1_in_10' already" in " ".join(twice.err.split())
    other = edp("data", "add-forecasts", run, logs, "--out", tmp_path / "other", "--answer", "speed_3")
    assert "does not answer this channel" in " ".join(other.err.split())
    assert not (tmp_path / "other").exists()


def test_a_log_of_another_rate_and_a_gap_in_the_commands_are_named(edp, run, logs, tmp_path):
    recording = read_recording(logs / "log_0.parquet")
    write_recording(replace(recording, rate_hz=recording.rate_hz / 2), tmp_path / "slow.parquet")
    slow = edp("data", "add-forecasts", run, tmp_path / "slow.parquet", "--out", tmp_path / "a")
    assert slow.code == 1
    assert "train a twin on logs of this rate" in " ".join(slow.err.split())
    values = recording.values.copy()
    values[250, 0] = np.nan
    write_recording(replace(recording, values=values), tmp_path / "gap.parquet")
    gap = edp("data", "add-forecasts", run, tmp_path / "gap.parquet", "--out", tmp_path / "b")
    assert gap.code == 1
    assert "missing or infinite value(s), first in row 250" in " ".join(gap.err.split())


def test_a_name_that_is_a_path_stays_in_the_folder(edp, run, logs, tmp_path):
    recording = read_recording(logs / "log_0.parquet")
    inner = tmp_path / "logs"
    inner.mkdir()
    for number, name in enumerate(("../../out", "../../out.", "<b>|=cmd")):
        write_recording(replace(recording, name=name), inner / f"{number}.parquet")
    assert edp("data", "add-forecasts", run, inner, "--out", tmp_path / "ahead").code == 0
    written = sorted(path.name for path in tmp_path.rglob("*.parquet") if path.parent != inner)
    assert len(written) == 3
    assert {path.parent for path in tmp_path.rglob("*.parquet")} == {inner, tmp_path / "ahead"}


def test_logs_are_there_all_together_or_not_at_all(edp, run, logs, tmp_path):
    inner = tmp_path / "logs"
    inner.mkdir()
    recording = read_recording(logs / "log_0.parquet")
    write_recording(replace(recording, name="first"), inner / "0.parquet")
    write_recording(replace(recording, name="second", values=recording.values[:10]), inner / "1.parquet")
    ended = edp("data", "add-forecasts", run, inner, "--out", tmp_path / "ahead")
    assert ended.code == 1
    assert "recording 'second': a prefix of 10 ticks came" in " ".join(ended.err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs"]
    (tmp_path / "ahead").mkdir()  # an empty folder is no folder in use
    assert edp("data", "add-forecasts", run, inner / "0.parquet", "--out", tmp_path / "ahead").code == 0
    assert [path.name for path in (tmp_path / "ahead").iterdir()] == ["0001_first.parquet"]


@pytest.mark.parametrize(
    ("option", "value"), [("--horizon", "0"), ("--horizon", "1000000000000"), ("--observer-gain", "2")]
)
def test_numbers_that_cannot_be_are_refused_before_logs_are_read(edp, run, tmp_path, option, value):
    ended = edp("data", "add-forecasts", run, tmp_path / "missing", "--out", tmp_path / "ahead", option, value)
    assert ended.code == 1
    assert option in ended.err
    assert not (tmp_path / "ahead").exists()
