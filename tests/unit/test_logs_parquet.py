"""Parquet tables as Simulink and its targets write them, and damaged or foreign ones."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edp.errors import DataError
from edp.logs import inspect_log, read_recording, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes


def table(path, columns, row_group=None, units=None):
    """Columns may be arrays or pyarrow arrays, and names may occur twice."""
    arrays = [column if isinstance(column, pa.Array) else pa.array(column) for _, column in columns]
    units = units or {}
    fields = [
        pa.field(name, array.type, metadata={"unit": units[name]} if name in units else None)
        for (name, _), array in zip(columns, arrays)
    ]
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path, row_group_size=row_group)
    return path


def padded(values, rows):
    return pa.array([*values, *[None] * (rows - len(values))], pa.float64())


TIME = np.arange(100) / 100


def test_one_time_for_all_and_vectors_as_lists(tmp_path):
    vectors = np.arange(300.0).reshape(100, 3)
    lists = pa.array(list(vectors))
    fixed = pa.FixedSizeListArray.from_arrays(pa.array(vectors.ravel() * 10), 3)
    path = table(tmp_path / "a.parquet", [("time", TIME), ("CylVels", lists), ("p", fixed)], 30, {"CylVels": "mm/s"})
    read = read_recording(path)
    assert read.channel_names == ("CylVels_1", "CylVels_2", "CylVels_3")
    np.testing.assert_allclose(read.values, vectors / 1000)
    read = read_recording(path, SignalMap((ChannelMap("p", "p_2"),)), rows=(40, 45))
    np.testing.assert_allclose(read.values[:, 0], vectors[40:45, 1] * 10)


def test_lists_of_varying_length_are_no_signals(tmp_path):
    ragged = pa.array([[1.0] * (1 + k % 2) for k in range(100)])
    path = table(tmp_path / "a.parquet", [("time", TIME), ("r", ragged), ("BmUp", TIME)])
    with pytest.raises(DataError, match="no column 'r_1'"):
        read_recording(path, SignalMap((ChannelMap("r", "r_1"),)))


@pytest.mark.parametrize("style", ["left", "named"])
def test_each_signal_may_have_its_own_time(tmp_path, style):
    """Signals of other rates have fewer rows; the rest of their columns is empty."""
    slow = np.arange(20) / 20
    columns = [
        ("time" if style == "left" else "CylVels_1_time", TIME),
        ("CylVels_1", TIME * 2),
        ("time" if style == "left" else "BmUp_time", padded(slow, 100)),
        ("BmUp", padded(slow * 10, 100)),
    ]
    path = table(tmp_path / "a.parquet", columns)
    read = read_recording(path)
    assert read.rate_hz == 100.0
    np.testing.assert_allclose(read.column("CylVels_1"), TIME[: read.samples] * 2, atol=1e-6)
    np.testing.assert_allclose(read.column("BmUp")[:6], [0, 0, 0, 0, 0, 0.5])


def test_one_name_twice_is_told_apart_by_place(tmp_path):
    columns = [("time", TIME), ("BmUp", TIME), ("BmUp", TIME * 3), ("BmDwn", TIME)]
    path = table(tmp_path / "a.parquet", columns)
    with pytest.raises(DataError, match=r"2 columns named 'BmUp': column_2.BmUp, column_3.BmUp"):
        read_recording(path)
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "column_3.BmUp"), ChannelMap("BmDwn", "BmDwn"))))
    np.testing.assert_allclose(read.values[:, 0], TIME * 3, atol=1e-6)
    twice = table(tmp_path / "b.parquet", [("time", TIME), ("time", TIME)])
    with pytest.raises(DataError, match="time"):
        read_recording(twice)


def test_a_row_group_at_a_time_gives_the_same(tmp_path):
    rng = np.random.default_rng(0)
    values = rng.standard_normal(100)
    path = table(tmp_path / "a.parquet", [("time", TIME), ("x", values)], row_group=7)
    wanted = SignalMap((ChannelMap("x", "x", kind=Kind.GENERIC),))
    whole = read_recording(path, wanted)
    np.testing.assert_array_equal(whole.values[:, 0], values.astype(np.float32))
    for rows in [(0, 1), (6, 8), (50, 100), (99, 100)]:
        np.testing.assert_array_equal(read_recording(path, wanted, rows=rows).values, whole.values[slice(*rows)])


def test_encrypted_files_say_so(tmp_path):
    path = tmp_path / "a.parquet"
    path.write_bytes(b"PARE" + bytes(range(200)) + b"PARE")
    with pytest.raises(DataError, match="an encrypted Parquet file"):
        read_recording(path)


def test_a_stamp_that_is_far_off_does_not_fill_the_memory(tmp_path):
    time = TIME.copy()
    time[-1] = 1e10
    path = table(tmp_path / "a.parquet", [("time", time), ("BmUp", TIME)])
    with pytest.raises(DataError, match=r"would take .* of memory.*a stamp that is far off"):
        read_recording(path)
    assert any("far off" in finding.what for finding in inspect_log(path).findings)
    path = table(tmp_path / "b.parquet", [("time", TIME * 1e9 + 1.7e18), ("BmUp", TIME)])
    with pytest.raises(DataError, match='set time_unit = "ms", "us" or "ns"'):
        read_recording(path)
    assert read_recording(path, SignalMap(time_unit="ns")).samples > 50


def test_a_recording_larger_than_memory_names_the_ways_out(tmp_path, monkeypatch):
    channels = (TABLE_A1["BmUp"],)
    path = write_recording(Recording("R", channels, np.zeros((50_000, 1), dtype=np.float32), 10.0), tmp_path / "a.mf4")
    monkeypatch.setattr("edp.storage.memory.free_bytes", lambda: 200_000)
    with pytest.raises(DataError, match="would take"):
        read_recording(path)
