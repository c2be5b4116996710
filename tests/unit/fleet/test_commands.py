"""Commands in units give what the commands give in one process, to the bit."""

import errno
from dataclasses import replace

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.errors import ConfigError, DataError, StorageError
from edp.jobs import Workers
from edp.logs import read_data_set
from edp.logs.source import DataSource
from edp.logs.store import building, read_store
from edp.sim import data_set, plan
from edp.sim.data_set import simulate_data_set
from edp.storage import replacing

pytestmark = pytest.mark.processes


def test_simulated_logs_are_the_same_and_a_stopped_set_goes_on(small_logs, small_order, here, tmp_path):
    seen = []

    def on_done(recording, kept):
        seen.append((recording.name, kept))
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_data_set(tmp_path / "logs", small_order, here, on_done)
    assert len(list((tmp_path / "logs").glob("*.parquet"))) == 2
    seen.clear()
    paths = simulate_data_set(tmp_path / "logs", small_order, here, lambda recording, kept: seen.append(kept))
    assert sorted(seen) == [False, False, True, True]
    for path in paths:
        assert path.read_bytes() == (small_logs / path.name).read_bytes()


def test_a_machine_file_that_differs_on_a_node_is_refused(small_order, here, tmp_path, monkeypatch):
    seen = iter(["mine", "theirs"])
    for module in (data_set, plan):
        monkeypatch.setattr(module, "machine_hash", lambda scenario: next(seen))
    with pytest.raises(ConfigError, match=r"machine '.*' has other numbers on this node"):
        simulate_data_set(tmp_path / "logs", replace(small_order, recordings=1, family=0), here)
    assert not list((tmp_path / "logs").glob("*.parquet"))


def test_a_folder_that_only_the_node_sees_is_told(small_order, here, tmp_path, monkeypatch):
    real = data_set.write_log

    def elsewhere(identity, where):
        (tmp_path / "node").mkdir(exist_ok=True)
        return real(identity, {"folder": str(tmp_path / "node")})

    monkeypatch.setattr(data_set, "write_log", elsewhere)
    with pytest.raises(StorageError, match="was written on another node"):
        simulate_data_set(tmp_path / "logs", replace(small_order, recordings=1), here)


def test_a_disk_that_fills_in_a_unit_is_named_and_what_was_written_stays(
    small_logs, small_order, here, tmp_path, monkeypatch
):
    real, written = data_set.write_recording, []

    def full(recording, path, options):
        if len(written) == 2:
            with replacing(path):
                raise OSError(errno.ENOSPC, "No space left on device")
        written.append(real(recording, path, options))

    monkeypatch.setattr(data_set, "write_recording", full)
    with pytest.raises(StorageError, match="No space left on device; free space"):
        simulate_data_set(tmp_path / "logs", small_order, here)
    assert len(list((tmp_path / "logs").glob("*.parquet"))) == 2
    monkeypatch.setattr(data_set, "write_recording", real)
    kept = []
    paths = simulate_data_set(tmp_path / "logs", small_order, here, lambda recording, there: kept.append(there))
    assert sorted(kept) == [False, False, True, True]
    assert [path.read_bytes() for path in paths] == [(small_logs / path.name).read_bytes() for path in paths]


def test_a_store_whose_disk_fills_in_a_unit_goes_on_where_it_was(small_logs, here, tmp_path, monkeypatch):
    monkeypatch.setattr(building, "BATCH_LOG_BYTES", 1)  # a batch a log
    real, done = building.store_batch, []

    def full(batch):
        if len(done) == 2:
            with replacing(tmp_path / "rows"):
                raise OSError(errno.ENOSPC, "No space left on device")
        done.append(batch.key)
        return real(batch)

    source = DataSource.from_path(small_logs)
    monkeypatch.setattr(building, "store_batch", full)
    with pytest.raises(StorageError, match="No space left on device; free space"):
        source.store(tmp_path / "store", here)
    with pytest.raises(DataError, match="is half built"):
        read_store(tmp_path / "store")
    monkeypatch.setattr(building, "store_batch", lambda batch: done.append(batch.key) or real(batch))
    index = source.store(tmp_path / "store", here)
    assert len(done) == len(set(done)) == 4  # none twice
    assert [one.digest for one in index.recordings] == [one.digest for one in read_data_set(small_logs)]


def test_a_store_built_in_units_holds_the_same_recordings_and_reads_nothing_twice(small_logs, here, tmp_path):
    source = DataSource.from_path(small_logs)
    told = NotedProgress()
    index = source.store(tmp_path / "store", here, told)
    assert index.hours() == pytest.approx(0.01)
    assert told.steps[-1] == 4
    DataSource.from_path(small_logs).store(tmp_path / "usual")
    for ours, usual in zip(read_store(tmp_path / "store"), read_store(tmp_path / "usual"), strict=True):
        assert (ours.name, ours.digest, dict(ours.meta)) == (usual.name, usual.digest, dict(usual.meta))
        np.testing.assert_array_equal(ours.values, usual.values)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "store" / "rows").iterdir()}
    source.store(tmp_path / "store", here)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "store" / "rows").iterdir()} == before


def test_logs_that_cannot_be_read_are_refused_as_in_one_process(small_logs, here, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    for log in sorted(small_logs.glob("*.parquet"))[:2]:
        (folder / log.name).write_bytes(log.read_bytes())
    (folder / "bad.parquet").write_bytes(b"PAR1 and nothing else")
    index = DataSource.from_path(folder).store(tmp_path / "store", here)
    usual = DataSource.from_path(folder).store(tmp_path / "usual")
    assert index.refused == usual.refused
    assert len(index.recordings) == 2
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is no store and not empty"):
        DataSource.from_path(folder).store(tmp_path / "full", here)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("stored", [False, True])
def test_an_inspection_in_units_is_that_of_one_process(small_logs, here, tmp_path, stored):
    source = DataSource.from_path(small_logs)
    if stored:
        source.store(tmp_path / "store")
        source = DataSource.from_path(tmp_path / "store")
    told = NotedProgress()
    assert source.inspect(told, here) == source.inspect()
    assert told.stages == [("recording" if stored else "log", 4)]
    assert told.steps[-1] == 4


@pytest.mark.slow
def test_two_processes_give_the_same_logs_store_and_inspection(small_logs, small_order, tmp_path):
    two = Workers(count=2)
    for path in simulate_data_set(tmp_path / "logs", small_order, two):
        assert path.read_bytes() == (small_logs / path.name).read_bytes()
    source = DataSource.from_path(small_logs)
    index = source.store(tmp_path / "store", two)
    usual = source.store(tmp_path / "usual")
    assert [entry.digest for entry in index.recordings] == [entry.digest for entry in usual.recordings]
    assert source.inspect(workers=two) == source.inspect()
