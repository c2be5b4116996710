"""Data-set stores: what comes out is what logs hold, whatever stopped or changed on the way."""

import json
import os
import shutil

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.data.features import FeatureSet
from edp.data.prepared import prepare
from edp.data.splits import SPLITS
from edp.data.task import TargetMode, Task
from edp.errors import BusyError, ConfigError, DataError
from edp.jobs import Workers
from edp.logs import Repair, read_data_set, write_recording
from edp.logs.source import DataSource
from edp.logs.store import build_store, check_store, is_store, read_index, read_store
from edp.logs.store.building import StoredLog
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage import hold

pytestmark = pytest.mark.processes

CHANNELS = (Channel("u", Kind.RATIO), Channel("p", Kind.PRESSURE, "head side"), Channel("v", Kind.VELOCITY))


def recording(name, seed, rows=400, rate_hz=50.0, channels=CHANNELS):
    values = np.random.default_rng(seed).normal(size=(rows, len(channels))).astype(np.float32)
    return Recording(name, channels, values, rate_hz, "sim:test", {"seed": seed, "deep": {"a": [1, None]}})


@pytest.fixture
def logs(tmp_path):
    folder = tmp_path / "logs"
    for number in range(5):
        write_recording(recording(f"run{number}", number, 300 + 10 * number), folder / f"run{number}.parquet")
    return folder


def build(logs, folder, **options):
    return DataSource.from_path(logs).store(folder, **options)


def assert_same(ours, theirs):
    assert [one.name for one in ours] == [one.name for one in theirs]
    for one, other in zip(ours, theirs):
        np.testing.assert_array_equal(one.values, other.values)
        assert one.channels == other.channels
        assert (one.rate_hz, one.source, dict(one.meta)) == (other.rate_hz, other.source, dict(other.meta))
        assert one.digest == other.digest == Recording(one.name, one.channels, one.values, one.rate_hz).digest


def test_a_store_gives_the_recordings_of_its_logs(logs, tmp_path):
    index = build(logs, tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))
    assert index == read_index(tmp_path / "store")
    assert index.hours() == pytest.approx(sum(one.duration_s for one in read_data_set(logs)) / 3600)
    assert_same(DataSource.from_path(tmp_path / "store").read(), read_data_set(logs))


def test_what_is_prepared_from_a_store_has_the_digest_of_its_logs(logs, tmp_path):
    build(logs, tmp_path / "store")
    task = Task(FeatureSet("all", ("u", "p", "v")), ("v",), (1, 5), TargetMode.ABSOLUTE, 50.0)
    ours, theirs = (
        prepare(read, task, SPLITS["recordings"](), 16)
        for read in (read_store(tmp_path / "store"), read_data_set(logs))
    )
    assert ours.digest == theirs.digest
    for part in ("train", "validation", "test"):
        for one, other in zip(getattr(ours, part), getattr(theirs, part), strict=True):
            np.testing.assert_array_equal(one.inputs, other.inputs)
            np.testing.assert_array_equal(one.targets, other.targets)


def test_samples_stay_in_the_files_of_the_store(logs, tmp_path):
    build(logs, tmp_path / "store")
    for one in read_store(tmp_path / "store"):
        assert not one.values.flags.owndata
        task = Task(FeatureSet("all", ("u", "p", "v")), ("v",), (1,), TargetMode.ABSOLUTE, 50.0)
        assert np.shares_memory(task.series(one).inputs, one.values)
        part = Task(FeatureSet("part", ("u", "p")), ("v",), (1,), TargetMode.ABSOLUTE, 50.0).series(one)
        assert one.on_disk
        assert np.shares_memory(part.inputs, one.values)
    in_memory = read_data_set(logs)[0]
    assert not in_memory.on_disk
    assert not np.shares_memory(
        Task(FeatureSet("part", ("u", "p")), ("v",), (1,), TargetMode.ABSOLUTE, 50.0).series(in_memory).inputs,
        in_memory.values,
    )


def test_what_is_written_to_samples_of_a_store_does_not_reach_its_files(logs, tmp_path):
    build(logs, tmp_path / "store")
    read_store(tmp_path / "store")[0].values[:] = 9.0
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))
    check_store(tmp_path / "store")


def test_long_logs_are_stored_in_parts(tmp_path, monkeypatch):
    monkeypatch.setattr("edp.logs.store.building.PART_SAMPLES", 37)
    monkeypatch.setattr("edp.recording.HASHED_ROWS", 11)
    write_recording(recording("a", 0, 401), tmp_path / "a.parquet")
    build(tmp_path / "a.parquet", tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(tmp_path / "a.parquet"))


def test_two_processes_build_the_same_store(logs, tmp_path, monkeypatch):
    monkeypatch.setattr("edp.logs.store.building.BATCH_LOG_BYTES", 1)
    build(logs, tmp_path / "one")
    build(logs, tmp_path / "two", workers=Workers(count=2))
    assert_same(read_store(tmp_path / "two"), read_store(tmp_path / "one"))


def test_logs_are_added_and_stored_ones_are_not_read_again(logs, tmp_path, monkeypatch):
    build(logs, tmp_path / "store")
    before = read_index(tmp_path / "store")
    write_recording(recording("run9", 9), logs / "run9.parquet")
    opened = []
    from edp.logs.store import building as module

    monkeypatch.setattr(module, "open_log", lambda path, m, real=module.open_log: opened.append(path) or real(path, m))
    index = build(logs, tmp_path / "store")
    assert [path.name for path in opened] == ["run9.parquet"]
    assert index.recordings[:5] == before.recordings
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))


def test_logs_of_another_folder_are_added_to_a_store(logs, tmp_path):
    build(logs, tmp_path / "store")
    write_recording(recording("run0", 7), tmp_path / "more" / "run0.parquet")
    build(tmp_path / "more", tmp_path / "store")
    names = [one.name for one in read_store(tmp_path / "store")]
    assert names == ["logs/run0", "run1", "run2", "run3", "run4", "more/run0"]


def test_a_changed_log_replaces_what_was_stored_of_it(logs, tmp_path):
    build(logs, tmp_path / "store")
    write_recording(recording("run2", 77, 222), logs / "run2.parquet")
    build(logs, tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))
    used = {entry.rows for entry in read_index(tmp_path / "store").recordings}
    assert {path.stem for path in (tmp_path / "store" / "rows").iterdir()} == used


def test_a_log_that_cannot_be_read_is_listed_and_tried_again(logs, tmp_path):
    good = (logs / "run1.parquet").read_bytes()
    (logs / "run1.parquet").write_bytes(good[:200])
    index = build(logs, tmp_path / "store")
    assert [refused.log for refused in index.refused] == [str(logs / "run1.parquet")]
    assert "run1.parquet" in index.refused[0].why
    assert len(read_store(tmp_path / "store")) == 4
    (logs / "run1.parquet").write_bytes(good)
    assert build(logs, tmp_path / "store").refused == ()
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))


@pytest.mark.parametrize("damage", [b"{", b"[]", b"null", "places", "lists", "cut"])
def test_a_damaged_record_of_a_stopped_build_is_made_again(logs, tmp_path, monkeypatch, damage):
    monkeypatch.setattr("edp.logs.store.building.BATCH_LOG_BYTES", 1)

    def stop(done, **values):
        if done == 2:
            raise Stopped

    with pytest.raises(Stopped):
        build(logs, tmp_path / "store", progress=NotedProgress(stop))
    record = sorted((tmp_path / "store" / "rows").glob("*.json"))[0]
    if isinstance(damage, bytes):
        record.write_bytes(damage)
    elif damage == "cut":
        rows = record.with_suffix(".f32")
        rows.write_bytes(rows.read_bytes()[:-4])
    else:
        table = json.loads(record.read_text())
        if damage == "places":
            table["recordings"][0]["first"] = 10**9
        else:
            table["lists"] = []
        record.write_text(json.dumps(table))
    build(logs, tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))


class Stopped(Exception):
    """Somebody pressed Ctrl-C."""


@pytest.mark.parametrize("after", [0, 1, 3])
def test_a_build_that_was_stopped_goes_on(logs, tmp_path, monkeypatch, after):
    monkeypatch.setattr("edp.logs.store.building.BATCH_LOG_BYTES", 1)

    def stop(done, **values):
        if done >= after:
            raise Stopped

    with pytest.raises(Stopped):
        build(logs, tmp_path / "store", progress=NotedProgress(stop))
    assert is_store(tmp_path / "store")
    with pytest.raises(DataError, match=r"is half built: .* give the same `edp data store build` again"):
        DataSource.from_path(tmp_path / "store").read()
    reached = NotedProgress()
    build(logs, tmp_path / "store", progress=reached)
    assert reached.steps[0] == after
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))


def test_maps_and_repairs_are_those_of_the_build(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,x,y\n" + "".join(f"{i / 10},{'' if i == 3 else i},{i * i}\n" for i in range(30)))
    (tmp_path / "map.toml").write_text(
        'time = "t"\n[channels.P]\ncolumn = "x"\nunit = "bar"\nkind = "pressure"\n[channels.Y]\ncolumn = "y"\n'
        'kind = "generic"\n'
    )
    source = DataSource.from_path(path, tmp_path / "map.toml", Repair(nan="hold"))
    source.store(tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), source.read())
    assert read_store(tmp_path / "store")[0].meta["repairs"]
    for given in (
        DataSource.from_path(tmp_path / "store", tmp_path / "map.toml"),
        DataSource(tmp_path / "store", None, Repair()),
    ):
        with pytest.raises(ConfigError, match=r"came with the store .* give them to `edp data store build`"):
            given.read()


def test_rows_names_and_machines_of_a_data_set_file_are_kept(logs, tmp_path):
    (tmp_path / "set.toml").write_text(
        '[[recordings]]\npath = "logs/run0.parquet"\nrows = [10, 90]\nname = "first"\nmachine = "M7"\n'
        '[[recordings]]\npath = "logs/run0.parquet"\nrows = [100, 190]\nname = "second"\n'
    )
    source = DataSource.from_path(tmp_path / "set.toml")
    source.store(tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), source.read())
    assert read_store(tmp_path / "store")[0].meta["machine"] == "M7"


def test_recordings_that_do_not_belong_together_are_refused_as_those_of_logs(logs, tmp_path):
    write_recording(recording("slow", 3, rate_hz=20.0), logs / "slow.parquet")
    build(logs, tmp_path / "store")
    with pytest.raises(DataError, match=r"mixed rates: run0.parquet 50 Hz, slow.parquet 20 Hz"):
        read_store(tmp_path / "store")


def test_a_file_that_was_cut_or_changed_is_refused_and_a_copied_one_is_taken(logs, tmp_path):
    build(logs, tmp_path / "store")
    rows = tmp_path / "store" / "rows" / f"{read_index(tmp_path / 'store').recordings[4].rows}.f32"
    os.utime(rows, ns=(1, 1))  # as a copy has it
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))
    check_store(tmp_path / "store")
    assert 1 in {file.written_ns for file in read_index(tmp_path / "store").files}
    whole = rows.read_bytes()
    rows.write_bytes(whole[:-4])
    with pytest.raises(DataError, match=r"has .* bytes, .* were stored"):
        read_store(tmp_path / "store")
    rows.write_bytes(whole[:-4] + b"\0\0\0\0")
    for read in (read_store, check_store):
        with pytest.raises(DataError, match=r"was changed since it was built: run4 of .* build again"):
            read(tmp_path / "store")
    rows.unlink()
    with pytest.raises(DataError, match=r"a file of the store, cannot be read"):
        read_store(tmp_path / "store")
    # What the messages advise: remove the file, build again.
    build(logs, tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(logs))


def test_a_store_is_built_by_one_process_into_a_folder_of_its_own(logs, tmp_path):
    with pytest.raises(ConfigError, match="is no store and not empty"):
        build(logs, logs)
    build(logs, tmp_path / "store")
    with pytest.raises(ConfigError, match="is a store already"):
        build(tmp_path / "store", tmp_path / "other")
    lock = hold(tmp_path / "store" / ".lock")
    with pytest.raises(BusyError):
        build(logs, tmp_path / "store")
    lock.close()


def test_a_log_that_is_gone_is_refused_by_name(tmp_path):
    index = build_store([StoredLog(tmp_path / "gone.csv")], tmp_path / "store")
    assert "gone.csv" in index.refused[0].why
    with pytest.raises(DataError, match=r"holds no recording; 1 log\(s\) were refused"):
        read_store(tmp_path / "store")


def test_a_copied_store_needs_nothing_of_where_it_was(logs, tmp_path):
    build(logs, tmp_path / "store")
    expected = read_data_set(logs)
    shutil.copytree(tmp_path / "store", tmp_path / "copy")
    shutil.rmtree(tmp_path / "store")
    shutil.rmtree(logs)
    assert_same(read_store(tmp_path / "copy"), expected)


def test_a_store_can_be_inspected(logs, tmp_path):
    build(logs, tmp_path / "store")
    quality = DataSource.from_path(tmp_path / "store").inspect()
    assert [report.name for report in quality.reports] == [f"run{i}" for i in range(5)]
    assert quality.reports[0].samples == 300


def test_the_index_of_a_store_is_plain_json_of_its_schema(logs, tmp_path):
    build(logs, tmp_path / "store")
    table = json.loads((tmp_path / "store" / "store.json").read_text())
    assert (table["kind"], table["schema"]) == ("edp-store", 2)
    assert [entry["samples"] for entry in table["recordings"]] == [300, 310, 320, 330, 340]
    rows = np.fromfile(tmp_path / "store" / "rows" / f"{table['recordings'][1]['rows']}.f32", "<f4")
    first = table["recordings"][1]["first"]
    np.testing.assert_array_equal(rows[first : first + 930].reshape(310, 3), read_data_set(logs)[1].values)


def test_a_store_is_read_from_python_and_screened(logs, tmp_path):
    import edp
    from edp.workflows.feature_selection.select import _read

    build(logs, tmp_path / "store")
    assert_same(list(edp.read(tmp_path / "store")), read_data_set(logs))
    source = DataSource.from_path(tmp_path / "store")
    assert_same(_read(source, source.inspect())[0], read_data_set(logs))
