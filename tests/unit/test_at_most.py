"""`--at-most HOURS`: a command looks at evenly spread stretches of a large data set, and says so."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from edp.cli import app
from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.logs import write_recording
from edp.logs.drawn import draw_recordings
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.workflows.judged_data import judged_data
from edp.workflows.train_evaluate import read_trained_run, train

from .test_workflow import CHANNELS, SMALL

pytestmark = pytest.mark.processes

HZ = 2.0
"""A stretch of two minutes has 240 rows."""
LENGTHS = (1500, 900, 120, 2000)
HALVED = (*SMALL, "training.updates=2", 'split={kind="time",validation_fraction=0.2,test_fraction=0.4}')


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("at_most")
    for number, rows in enumerate(LENGTHS):
        values = np.cumsum(np.random.default_rng(number).normal(size=(rows, 2)), axis=0)
        write_recording(
            Recording(f"run{number}", CHANNELS, values.astype(np.float32), HZ, source="test"),
            folder / "logs" / f"run{number}.parquet",
        )
    DataSource.from_path(folder / "logs").store(folder / "store")
    return folder / "store"


@pytest.fixture(scope="module")
def run(store):
    train(DataSource.from_path(store), load_experiment(None, "quick", list(HALVED)), store.parent / "run")
    return store.parent / "run"


def test_stretches_are_whole_two_minutes_of_all_recordings_and_stay_on_disk(store):
    drawn = DataSource(store, at_most_h=0.25).read()
    assert {one.name.split("[")[0] for one in drawn} >= {"run0", "run3"}
    assert 0 < sum(one.samples for one in drawn) <= 0.25 * 3600 * HZ
    assert all(one.on_disk for one in drawn)
    assert [one.name for one in DataSource(store, at_most_h=1.0).read()] == ["run0", "run1", "run2", "run3"]


def test_an_inspection_says_that_it_looked_at_a_part_of_the_data(store):
    source = DataSource(store, at_most_h=0.2)
    ours = source.inspect()
    (note,) = [finding for finding in ours.findings if "--max-hours" in finding.advice]
    stretches = draw_recordings(DataSource.from_path(store).read(), 0.2)
    assert note.what.startswith(f"looked at 0.2 of 0.6278 h: {len(stretches)} evenly spread")
    assert not DataSource(store, at_most_h=5.0).inspect().findings


def test_what_was_drawn_is_in_the_facts_that_read_the_same_data_again(store):
    source = DataSource(store, at_most_h=0.2)
    assert DataSource.from_dict(source.to_dict()) == DataSource(store.resolve(), at_most_h=0.2)
    assert "at_most_h" not in DataSource.from_path(store).to_dict()


@pytest.mark.parametrize("hours", [0.0, -1.0, float("nan"), float("inf")])
def test_hours_that_are_none_are_refused(store, hours):
    with pytest.raises(ConfigError, match="a positive number of hours must hold"):
        DataSource(store, at_most_h=hours)


def test_logs_are_refused_with_the_command_that_stores_them(store):
    logs = DataSource(store.parent / "logs", at_most_h=1.0)
    for look in (logs.read, logs.inspect):
        with pytest.raises(ConfigError, match=r"no store.*edp data store build"):
            look()


def test_an_evaluation_judges_on_stretches_and_says_so(run):
    said = CliRunner().invoke(app, ["evaluate", str(run), "--at-most", "0.1"])
    scores = json.loads((run / "scores.json").read_text())
    drawn = scores["drawn"]
    assert drawn["hours"] <= 0.11 < drawn["of_hours"]
    assert f"judged on {drawn['what']}" in " ".join(said.output.split())
    assert all("[" in name for name in scores["models"]["network"]["recordings"])
    CliRunner().invoke(app, ["evaluate", str(run)])
    assert "drawn" not in json.loads((run / "scores.json").read_text())


def test_other_recordings_are_drawn_before_they_are_read(run, store):
    bundle, _, _, data = read_trained_run(run)
    others = DataSource.from_path(store).read()
    judged, drawn = judged_data(bundle, data, others, 0.2)
    assert drawn is not None
    assert drawn.stretches == len(judged.test)
    assert {part.samples for part in judged.test} <= {240, 120}  # run2 is shorter than a stretch
    assert judged_data(bundle, data, others, None)[1] is None
    assert judged_data(bundle, data, None, 50.0)[1] is None
