"""Round trips over the format registry and files written by other tools."""

from __future__ import annotations

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from edp.errors import DataError
from edp.logs import (
    FORMATS,
    LAYOUTS,
    WriteOptions,
    find_recordings,
    inspect_log,
    open_log,
    read_data_set,
    read_recording,
    write_recording,
)
from edp.logs.formats.matlab.library import MatlabOpaque, matio
from edp.logs.formats.matlab.library import pandas as pd
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap
from edp.testing import check_log_format

pytestmark = pytest.mark.processes

NAMES = ("CylVels_1", "CylPressures_1", "BmUp")


def make(rows=400, seed=0, name="R1", rate=100.0):
    rng = np.random.default_rng(seed)
    scale = np.array([0.1, 1e7, 1e6])
    values = (rng.standard_normal((rows, 3)) * scale).astype(np.float32)
    return Recording(name, tuple(TABLE_A1[n] for n in NAMES), values, rate, "sim:test", {"seed": seed, "text": "ü"})


@pytest.mark.parametrize("name", list(FORMATS))
def test_every_format_keeps_the_contract(name):
    check_log_format(FORMATS[name])


@pytest.mark.parametrize("suffix", [part.suffixes[0] for part in FORMATS.values()])
def test_round_trip_keeps_every_bit(tmp_path, suffix):
    """Through the process that reads logs, too."""
    recording = make(rate=128.98)
    read = read_recording(write_recording(recording, tmp_path / f"R1{suffix}"))
    assert read.values.tobytes() == recording.values.tobytes()
    assert read.channels == recording.channels
    assert read.rate_hz == pytest.approx(128.98, rel=1e-9)
    assert read.name == "R1"


@pytest.mark.parametrize("version", ["v5", "v7.3"])
@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_mat_layouts_round_trip(tmp_path, layout, version):
    recording = make()
    path = write_recording(recording, tmp_path / "a.mat", WriteOptions(layout, version))
    assert path.read_bytes()[:10] == (b"MATLAB 7.3" if version == "v7.3" else b"MATLAB 5.0")
    read = read_recording(path)
    assert read.digest == recording.digest
    assert (read.name, read.source, read.meta) == ("R1", "sim:test", recording.meta)


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_mat_layouts_read_without_our_own_facts(tmp_path, layout):
    """What another reader sees: the objects alone carry names, values and time."""
    recording = make()
    write_recording(recording, tmp_path / "a.mat", WriteOptions(layout))
    variables = matio.load_from_mat(str(tmp_path / "a.mat"))
    main = LAYOUTS[layout].variable
    assert set(variables) - {"__header__", "__version__", "tout"} == {main, "edp_info"}
    raw = open_log(tmp_path / "a.mat", SignalMap(variable=main))
    np.testing.assert_allclose(raw.signals["BmUp"].time_s, np.arange(400) / 100, atol=1e-9)


def test_parquet_keeps_channels_outside_the_vocabulary_and_nan(tmp_path):
    values = np.array([[1.0], [np.nan], [3.0]], dtype=np.float32)
    recording = Recording("x", (Channel("Tank", Kind.TEMPERATURE, "oil"),), values, 10.0)
    path = write_recording(recording, tmp_path / "x.parquet")
    assert inspect_log(path).channels[0].missing == 1
    with pytest.raises(DataError, match="'Tank' has 1 missing"):
        read_recording(path)
    stored = pq.read_schema(path)
    assert stored.field("Tank").metadata[b"unit"] == b"K"


def test_parquet_from_another_tool_with_units_and_time_stamps(tmp_path):
    time = pa.array((np.arange(50) * 20_000).astype("datetime64[us]"))
    field = pa.field("BmUp", pa.float64(), metadata={"unit": "bar"})
    schema = pa.schema([pa.field("Time", time.type), field, pa.field("note", pa.string())])
    table = pa.Table.from_arrays([time, pa.array(np.full(50, 2.0)), pa.array(["a"] * 50)], schema=schema)
    pq.write_table(table, tmp_path / "sdi.parquet")
    read = read_recording(tmp_path / "sdi.parquet")
    assert read.rate_hz == 50.0
    assert read.values[0, 0] == np.float32(2e5)


CSV_TEXTS = {
    "plain": "time,BmUp,CylVels_1\n0,100000,0.1\n0.01,200000,0.2\n0.02,300000,0.3\n",
    "units in header": "time [ms],BmUp [bar],CylVels_1 (mm/s)\n0,1,100\n10,2,200\n20,3,300\n",
    "units row": "time,BmUp,CylVels_1\ns,bar,mm/s\n0,1,100\n0.01,2,200\n0.02,3,300\n",
    "decimal comma": "time;BmUp [bar];CylVels_1\n0;1;0,1\n0,01;2;0,2\n0,02;3;0,3\n",
    "tabs": "time\tBmUp [bar]\tCylVels_1\n0\t1\t0.1\n0.01\t2\t0.2\n0.02\t3\t0.3\n",
    "comments, CRLF, quotes": '# logger 3\r\n"time","BmUp [bar]","CylVels_1",\r\n'
    "0,1,0.1,\r\n0.01,2,0.2,\r\n0.02,3,0.3,\r\n",
    "extra text column": "time,BmUp [bar],CylVels_1,operator\n0,1,0.1,Kim\n0.01,2,0.2,Kim\n0.02,3,0.3,Lee\n",
    "dates": "Timestamp,BmUp [bar],CylVels_1\n"
    "2024-01-01 10:00:00.000,1,0.1\n2024-01-01 10:00:00.010,2,0.2\n2024-01-01 10:00:00.020,3,0.3\n",
}


@pytest.mark.parametrize("text", CSV_TEXTS.values(), ids=CSV_TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_csv_spellings_give_the_same_recording(tmp_path, text, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "BmUp"), ChannelMap("CylVels_1", "CylVels_1"))))
    assert read.rate_hz == 100.0
    np.testing.assert_allclose(read.values, [[1e5, 0.1], [2e5, 0.2], [3e5, 0.3]], rtol=1e-6)


def test_csv_in_a_windows_code_page(tmp_path):
    rows = "".join(f"{i};{i},5\n" for i in range(400))
    (tmp_path / "a.csv").write_bytes(f"time;Öl (°C)\n{rows}".encode("cp1252"))
    read = read_recording(tmp_path / "a.csv", SignalMap((ChannelMap("Oil", "Öl", kind=Kind.TEMPERATURE),)))
    assert read.values[2, 0] == np.float32(275.65)


def test_csv_without_header_by_a_map(tmp_path):
    (tmp_path / "a.csv").write_text("0,1,5\n0.1,2,6\n0.2,3,7\n")
    signal_map = SignalMap((ChannelMap("x", "load", scale=2.0),), header=False, columns=("t", "ref", "load"))
    read = read_recording(tmp_path / "a.csv", signal_map)
    assert read.values.ravel().tolist() == [10.0, 12.0, 14.0]
    assert read.rate_hz == 10.0
    with pytest.raises(DataError, match="header = false"):
        read_recording(tmp_path / "a.csv")
    with pytest.raises(DataError, match="name all 3"):
        read_recording(tmp_path / "a.csv", SignalMap(header=False, columns=("t", "ref")))


def test_map_order_constant_scale_and_offset(tmp_path):
    (tmp_path / "a.csv").write_text("t,P1,T\n0,1,20\n1,2,20\n2,3,20\n")
    signal_map = SignalMap(
        (
            ChannelMap("Oil", "T", "degC", Kind.TEMPERATURE),
            ChannelMap("BmUp", "absent", constant=5.0),
            ChannelMap("CylPressures_1", "P1", "bar", scale=10.0),
        )
    )
    read = read_recording(tmp_path / "a.csv", signal_map)
    assert read.channel_names == ("Oil", "BmUp", "CylPressures_1")
    np.testing.assert_allclose(read.values[1], [293.15, 5.0, 2e6], rtol=1e-6)


def test_mat_struct_arrays_and_scalars_written_by_scipy(tmp_path):
    time = (np.arange(100) * 0.01).reshape(1, -1)
    log = {"time": time, "BmUp": np.ones((100, 1)), "CylVels": np.arange(300.0).reshape(100, 3), "gain": 4.0}
    scipy.io.savemat(tmp_path / "a.mat", {"log": log, "kp": 2.5, "note": "text"})
    read = read_recording(tmp_path / "a.mat")
    assert set(read.channel_names) == {"CylVels_1", "CylVels_2", "CylVels_3", "BmUp"}
    assert read.column("CylVels_2")[1] == 4.0
    mapped = read_recording(tmp_path / "a.mat", SignalMap((ChannelMap("k", "kp"), ChannelMap("BmUp", "BmUp"))))
    assert mapped.column("k").tolist() == [2.5] * 100


def test_mat_v4_and_structure_with_time(tmp_path):
    scipy.io.savemat(tmp_path / "v4.mat", {"t": np.arange(50) * 0.02, "BmUp": np.arange(50.0)}, format="4")
    assert read_recording(tmp_path / "v4.mat").rate_hz == 50.0
    signals = np.empty(2, dtype=[("values", object), ("label", object)])
    signals[0] = (np.arange(50.0).reshape(-1, 1), "BmUp")
    signals[1] = (np.ones((50, 1)), "BmDwn")
    scipy.io.savemat(tmp_path / "s.mat", {"out": {"time": np.arange(50) * 0.02, "signals": signals}})
    read = read_recording(tmp_path / "s.mat")
    assert read.channel_names == ("BmUp", "BmDwn")
    assert read.rate_hz == 50.0


def test_mat_v73_written_with_h5py(tmp_path):
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", np.arange(60) * 0.01), ("BmUp", np.arange(60.0))):
            data = file.create_dataset(name, data=values.reshape(1, -1))
            data.attrs["MATLAB_class"] = np.bytes_("double")
    block = b"MATLAB 7.3 MAT-file, Platform: PCWIN64, Created by h5py".ljust(116, b" ") + bytes(8) + b"\x00\x02IM"
    with path.open("rb+") as stream:
        stream.write(block)
    read = read_recording(path)
    assert (read.rate_hz, read.samples) == (100.0, 60)


def timeseries(name, data, time, unit=""):
    """A timeseries with the properties that Simulink saves."""
    meta = MatlabOpaque({"Units": np.array([unit])}, "tsdata.datametadata")
    info = {"Units": np.array(["seconds"]), "Length": np.array([[float(len(time))]]), "Time_": time.reshape(-1, 1)}
    props = {
        "Name": np.array([name]),
        "DataInfo": meta,
        "TimeInfo": MatlabOpaque(info, "tsdata.timemetadata"),
        "Data_": data,
        "Time_": np.empty((0, 0)),
        "IsTimeFirst_": np.array([[data.ndim == 2]]),
    }
    return MatlabOpaque(props, "timeseries")


def test_dataset_of_timeseries_with_units_shapes_and_own_times(tmp_path):
    fast, slow = np.arange(101) * 0.01, np.arange(21) * 0.05
    elements = np.empty((1, 2), dtype=object)
    elements[0, 0] = timeseries("BmUp", np.arange(101.0).reshape(1, 1, 101), fast, "bar")
    inner = timeseries("", np.arange(21.0).reshape(-1, 1), slow, "mm/s")
    elements[0, 1] = MatlabOpaque({"Name": np.array(["CylVels_1"]), "Values": inner}, "Simulink.SimulationData.Signal")
    store = np.empty((1, 1), dtype=[("Elements", object)])
    store[0, 0]["Elements"] = elements
    storage = MatlabOpaque({"any": store}, "Simulink.SimulationData.Storage.RamDatasetStorage")
    outer = np.empty((1, 1), dtype=[("Name", object), ("Storage", object)])
    outer[0, 0]["Name"], outer[0, 0]["Storage"] = np.array(["logs"]), storage
    matio.save_to_mat(
        str(tmp_path / "d.mat"), {"logsout": MatlabOpaque({"any": outer}, "Simulink.SimulationData.Dataset")}
    )
    read = read_recording(tmp_path / "d.mat")
    assert read.rate_hz == 100.0
    assert read.column("BmUp")[7] == np.float32(7e5)
    # Held, never interpolated: tick 7 (0.07 s) still has the slow sample of 0.05 s.
    assert read.column("CylVels_1")[7] == np.float32(1e-3)


@pytest.mark.filterwarnings("ignore:duration_to_mat")
def test_timetable_written_by_matio(tmp_path):
    index = pd.TimedeltaIndex((np.arange(30) * 10_000_000).astype("timedelta64[ns]"), name="Time")
    matio.save_to_mat(
        str(tmp_path / "t.mat"), {"tt": pd.DataFrame({"BmUp": np.arange(30.0)}, index=index)}, version="v7"
    )
    read = read_recording(tmp_path / "t.mat")
    assert (read.rate_hz, read.samples) == (100.0, 30)


def test_data_set_refuses_mixed_rates_and_channels_and_names_stay_unique(tmp_path):
    for folder, rate in (("a", 100.0), ("b", 100.0)):
        (tmp_path / folder).mkdir()
        write_recording(make(rate=rate), tmp_path / folder / "R1.csv")
    names = [recording.name for recording in read_data_set(tmp_path)]
    assert names == ["a/R1", "b/R1"]
    write_recording(make(rate=50.0), tmp_path / "b" / "R2.csv")
    with pytest.raises(DataError, match=r"mixed rates: R1.csv 100 Hz, R2.csv 50 Hz; set rate_hz"):
        read_data_set(tmp_path)
    resampled = read_data_set(tmp_path, SignalMap((ChannelMap("BmUp", "BmUp"),), rate_hz=50.0))
    assert {recording.rate_hz for recording in resampled} == {50.0}
    (tmp_path / "b" / "R2.csv").write_text("time,BmUp\n0,1\n0.01,2\n0.02,3\n")
    with pytest.raises(DataError, match=r"mixed channels: R2.csv lacks CylPressures_1, CylVels_1"):
        read_data_set([tmp_path / "a", tmp_path / "b" / "R2.csv"])


def test_find_recordings_says_what_it_looks_for(tmp_path):
    with pytest.raises(DataError, match=r"known endings: \.csv"):
        find_recordings(tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        find_recordings(tmp_path / "none")
    for name in ("b.csv", "a.parquet", ".hidden.csv", "readme.md"):
        (tmp_path / name).write_text("x")
    assert [path.name for path in find_recordings(tmp_path)] == ["a.parquet", "b.csv"]


def test_a_folder_of_files_that_are_not_read_says_how_they_become_logs(tmp_path):
    for number in range(3):
        np.savez(tmp_path / f"joint_{number}.npz", q=np.zeros(5))
    (tmp_path / "notes.md").write_text("of the rig")
    with pytest.raises(DataError, match=r"3 end in '\.npz': write its arrays as CSV or Parquet"):
        find_recordings(tmp_path)


def test_text_files_are_logs_where_there_are_no_others(tmp_path):
    (tmp_path / "a.txt").write_text("time,x\n0,1\n")
    assert [path.name for path in find_recordings(tmp_path)] == ["a.txt"]
    (tmp_path / "b.csv").write_text("time,x\n0,1\n")
    assert [path.name for path in find_recordings(tmp_path)] == ["b.csv"]


def test_a_map_may_take_all_other_columns(tmp_path):
    path = tmp_path / "a.csv"
    rows = "\n".join(f"{k / 100},{k},{k / 10},ok,{k % 7},{k % 5},{k % 3}" for k in range(50))
    path.write_text(f"time,u [bar],CylVels_1 [mm/s],state,torque [Nm],share [%],q [l/min]\n{rows}\n")
    whole = read_recording(path, SignalMap(others=True))
    kinds = {channel.name: channel.kind for channel in whole.channels}
    assert kinds == {
        "u": Kind.PRESSURE,
        "CylVels_1": Kind.VELOCITY,
        "torque": Kind.GENERIC,
        "share": Kind.RATIO,
        "q": Kind.FLOW,
    }
    assert whole.column("u")[1] == pytest.approx(1e5)
    assert whole.column("CylVels_1")[10] == pytest.approx(1e-3)
    mapped = read_recording(path, SignalMap((ChannelMap("pilot", "u", kind=Kind.PILOT_PRESSURE),), others=True))
    assert mapped.channel_names == ("pilot", "CylVels_1", "torque", "share", "q")


def test_a_folder_read_whole_keeps_what_all_logs_hold(tmp_path):
    for name, columns in (("a", "u,v,w"), ("b", "v,u,x")):
        rows = "\n".join(f"{k / 100},{k},{k % 7},{k % 5}" for k in range(50))
        (tmp_path / f"{name}.csv").write_text(f"time,{columns}\n{rows}\n")
    found = read_data_set(tmp_path, SignalMap(others=True))
    assert [recording.channel_names for recording in found] == [("u", "v"), ("u", "v")]
    assert found[1].column("u")[8] == 1
    (tmp_path / "b.csv").write_text("time,x\n0,1\n0.01,2\n0.02,3\n")
    with pytest.raises(DataError, match="no channel is in all of the 2 recordings"):
        read_data_set(tmp_path, SignalMap(others=True))
