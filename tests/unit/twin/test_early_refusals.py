"""What a twin could not be judged on is refused before anything is trained."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from edp.config.twin import load_twin_experiment
from edp.errors import DataError
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.networks.twin.recurrent import Recurrent
from edp.testing.twins import sample_actuators, sample_front, sample_twin
from edp.training.twin_bundle import TwinBundle, save_twin
from edp.workflows.identify import identify
from edp.workflows.twin import choose_twin, continue_twin, fit_twin, train_twin

pytestmark = pytest.mark.processes

ASTRAY = 1e3
"""Metres by which strokes of a part are moved."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for seed in range(5):
        write_recording(sample_actuators(seed=seed), folder / f"log_{seed}.parquet")
    return DataSource.from_path(folder)


@pytest.fixture
def trains_nothing(monkeypatch):
    def called(*args, **options):
        pytest.fail("a twin is trained before the refusal")

    monkeypatch.setattr(fit_twin.TwinFit, "fitted", called)
    monkeypatch.setattr(choose_twin.TwinChoice, "best", called)


def with_part(monkeypatch, part, change):
    """Let `train_twin` see another part of the data."""
    module = sys.modules["edp.workflows.twin.train_twin"]
    prepared = module.cut_recordings

    def changed(recordings, experiment):
        channels, data = prepared(recordings, experiment)
        return channels, replace(data, **{part: [change(series, channels) for series in getattr(data, part)]})

    monkeypatch.setattr(module, "cut_recordings", changed)


def moved(series, channels):
    shift = np.zeros(series.targets.shape[1], np.float32)
    shift[len(channels.velocities) : len(channels.velocities) + len(channels.strokes)] = ASTRAY
    return replace(series, targets=series.targets + shift)


def cut(series, channels):
    return replace(series, inputs=series.inputs[:20], targets=series.targets[:20])


@pytest.mark.parametrize(
    ("kind", "part", "change", "message"),
    [
        ("recurrent", "test", moved, "starts lie beyond an end stop"),
        ("recurrent", "validation", moved, "starts lie beyond an end stop"),
        ("auto", "test", moved, "starts lie beyond an end stop"),
        ("greybox", "test", moved, "starts lie beyond an end stop"),
        ("recurrent", "test", cut, "the longest recording has 20 ticks"),
        ("auto", "test", cut, "the longest recording has 20 ticks"),
    ],
)
def test_parts_without_a_start_are_refused_at_once(
    logs, trains_nothing, monkeypatch, tmp_path, kind, part, change, message
):
    with_part(monkeypatch, part, change)
    out = tmp_path / "run"
    with pytest.raises(DataError, match=message):
        train_twin(logs, load_twin_experiment(None, (f"twin.kind={kind}",)), out)
    assert not out.exists(), "a refused command keeps the corrected one out of the folder"


@pytest.mark.parametrize("part", ["test", "validation"])
@pytest.mark.parametrize(("change", "message"), [(moved, "beyond an end stop"), (cut, "the longest recording has 20")])
def test_a_twin_that_goes_on_is_refused_at_once_too(logs, monkeypatch, tmp_path, part, change, message):
    spec = Recurrent(units=4)
    save_twin(TwinBundle(spec, sample_twin(spec)[0]), tmp_path / "base" / "twin")
    monkeypatch.setattr(continue_twin.ContinuedTwin, "best", lambda self: pytest.fail("trained before the refusal"))
    with_part(monkeypatch, part, change)
    out = tmp_path / "run"
    with pytest.raises(DataError, match=message):
        train_twin(logs, load_twin_experiment(None, ()), out, start=tmp_path / "base")
    assert not out.exists()


@pytest.fixture
def identifies_nothing(monkeypatch):
    module = sys.modules["edp.workflows.identify.identify"]
    monkeypatch.setattr(module, "_fit_grey_box", lambda *args: pytest.fail("a grey box is fitted before the refusal"))
    return module


def front_logs(folder):
    for seed in range(5):
        write_recording(sample_front(seed=seed), folder / f"log_{seed}.parquet")
    return DataSource.from_path(folder)


@pytest.mark.parametrize(("change", "message"), [(moved, "beyond an end stop"), (cut, "the longest recording has 20")])
def test_identify_refuses_a_test_part_without_a_start_at_once(
    identifies_nothing, monkeypatch, tmp_path, change, message
):
    prepared = identifies_nothing.cut_recordings

    def changed(recordings, experiment):
        channels, data = prepared(recordings, experiment)
        return channels, replace(data, test=[change(series, channels) for series in data.test])

    monkeypatch.setattr(identifies_nothing, "cut_recordings", changed)
    # Strokes of the machine are checked apart.
    monkeypatch.setattr(identifies_nothing, "_check_strokes", lambda *args: None)
    with pytest.raises(DataError, match=message):
        identify(front_logs(tmp_path), tmp_path / "mine.toml", "M22")
    assert not (tmp_path / "mine.toml").exists()
