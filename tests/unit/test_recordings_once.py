"""The memory of logs that tests share: what is in the file decides, and what a test does to its numbers stays there."""

import numpy as np
import pytest
import recordings

from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import Channel, Kind

pytestmark = pytest.mark.processes


def written(path, value):
    return write_recording(
        Recording("a", (Channel("u", Kind.GENERIC),), np.full((20, 1), value, np.float32), 50.0), path
    )


@pytest.fixture
def read(monkeypatch):
    """Calls of what reads a log."""
    calls = []

    def plain(path, signal_map=None, **options):
        calls.append(path)
        return Recording("a", (Channel("u", Kind.GENERIC),), np.zeros((20, 1), np.float32), 50.0)

    monkeypatch.setattr("edp.logs.read.read_recording", recordings._remembering(plain))
    return calls


def test_a_log_is_read_once_and_a_changed_one_again(read, tmp_path):
    source = DataSource.from_path(written(tmp_path / "a.parquet", 1.0))
    first = source.read()[0]
    first.values[:] = 7.0
    assert (source.read()[0].values == 0.0).all()
    assert len(read) == 1
    written(tmp_path / "a.parquet", 2.0)
    source.read()
    assert len(read) == 2
    DataSource.from_path(written(tmp_path / "b.parquet", 2.0)).read()
    assert len(read) == 3


def test_tests_about_reading_read_each_time(read, tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "_on", [False])
    source = DataSource.from_path(written(tmp_path / "a.parquet", 1.0))
    source.read()
    source.read()
    assert len(read) == 2
