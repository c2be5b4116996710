"""Truth of a simulation apart from what sensors show, and the layouts of Simulink and target logs."""

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import (
    FORMATS,
    LAYOUTS,
    WriteOptions,
    find_recordings,
    open_log,
    read_data_set,
    read_recording,
    read_truth,
    truth_path,
    write_recording,
)
from edp.logs.formats.matlab.library import matio
from edp.recording import Recording
from edp.signals import TABLE_A1, VOCABULARY, Channel, Kind, SignalMap

pytestmark = pytest.mark.processes

TRUTH = {name: channel for name, channel in VOCABULARY.items() if name not in TABLE_A1}
SUFFIXES = [part.suffixes[0] for part in FORMATS.values()]


def simulated(rows=50, names=tuple(VOCABULARY)):
    values = np.random.default_rng(0).normal(size=(rows, len(names))).astype(np.float32)
    return Recording("run", tuple(VOCABULARY[name] for name in names), values, 100.0, "sim:M22", {"seed": 3})


def columns(recording, names):
    np.testing.assert_array_equal(recording.channel_names, list(names))
    return recording.select(list(names))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truth_apart_is_not_read_with_the_log_but_can_be_read_alone(tmp_path, suffix):
    recording = simulated()
    path = write_recording(recording, tmp_path / f"run{suffix}", WriteOptions(truth="apart"))
    assert find_recordings(tmp_path) == (path,)
    read = read_recording(path)
    np.testing.assert_array_equal(columns(read, TABLE_A1), recording.select(list(TABLE_A1)))
    assert len(read_data_set(tmp_path)) == 1
    truth = read_truth(path)
    np.testing.assert_array_equal(columns(truth, TRUTH), recording.select(list(TRUTH)))
    assert [c.kind for c in truth.channels] == [c.kind for c in TRUTH.values()]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truth_can_be_left_out(tmp_path, suffix):
    path = write_recording(simulated(), tmp_path / f"run{suffix}", WriteOptions(truth="without"))
    assert read_recording(path).channel_names == tuple(TABLE_A1)
    assert read_truth(path) is None
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_truth_file_whose_log_is_gone_is_a_log(tmp_path):
    path = write_recording(simulated(), tmp_path / "run.csv", WriteOptions(truth="apart"))
    path.unlink()
    assert find_recordings(tmp_path) == (truth_path(path),)


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_mat_layouts_keep_truth_in_a_variable_of_its_own(tmp_path, layout):
    recording = simulated()
    path = write_recording(recording, tmp_path / "run.mat", WriteOptions(layout, truth="apart"))
    read = read_recording(path)
    np.testing.assert_array_equal(columns(read, TABLE_A1), recording.select(list(TABLE_A1)))
    truth = read_recording(path, SignalMap(variable="truth"))
    np.testing.assert_array_equal(columns(truth, TRUTH), recording.select(list(TRUTH)))


@pytest.mark.parametrize("version", ["v5", "v7.3"])
def test_a_target_log_has_time_vectors_and_pilots_in_one_struct(tmp_path, version):
    recording = simulated()
    path = write_recording(recording, tmp_path / "run.mat", WriteOptions("speedgoat", version, "apart"))
    variables = matio.load_from_mat(str(path))
    data = variables["data"]
    assert {"data", "truth", "edp_info"} <= set(variables)
    assert data["CylVels"][0, 0].shape == (50, 3)
    pressures = data["CylPressures"][0, 0]
    assert pressures.shape == (50, 7)
    assert np.isnan(pressures[:, 3]).all()
    np.testing.assert_array_equal(pressures[:, 4], recording.column("CylPressures_5"))
    np.testing.assert_allclose(data["time"][0, 0][:, 0], np.arange(50) / 100)
    assert set(TABLE_A1) - set(data.dtype.names) == {n for n in TABLE_A1 if n.startswith("Cyl")}
    raw = open_log(path, SignalMap(variable="data"))
    assert raw.rate_hz == 100.0


def test_a_simulink_log_has_logsout_and_tout(tmp_path):
    path = write_recording(simulated(), tmp_path / "run.mat", WriteOptions("simulink", truth="apart"))
    variables = matio.load_from_mat(str(path))
    assert variables["logsout"].classname == "Simulink.SimulationData.Dataset"
    np.testing.assert_allclose(np.ravel(variables["tout"]), np.arange(50) / 100)


@pytest.mark.parametrize("layout", ["simulink", "speedgoat"])
def test_names_that_only_look_like_vectors_come_back(tmp_path, layout):
    names = ("A_1", "B_2", "B_3", "C", "C_1", "C_2", "D_00", "D_01", "E_1", "E_9", "F_1", "F_2")
    channels = tuple(Channel(name, Kind.GENERIC) for name in names)
    values = np.arange(5 * len(names), dtype=np.float32).reshape(5, -1)
    recording = Recording("x", channels, values, 10.0)
    read = read_recording(write_recording(recording, tmp_path / "x.mat", WriteOptions(layout)))
    assert read.digest == recording.digest


def test_logs_without_truth_or_of_nothing_else(tmp_path):
    only = simulated(names=tuple(TABLE_A1))
    assert read_recording(write_recording(only, tmp_path / "a.mat", WriteOptions(truth="apart"))).digest == only.digest
    write_recording(only, tmp_path / "a.csv", WriteOptions(truth="apart"))
    assert not truth_path(tmp_path / "a.csv").exists()
    with pytest.raises(DataError, match="no channel but truth"):
        write_recording(simulated(names=tuple(TRUTH)), tmp_path / "b.csv", WriteOptions(truth="without"))
    with pytest.raises(DataError, match="did you mean 'apart'"):
        WriteOptions(truth="aparts")


def test_truth_that_only_some_logs_hold_does_not_part_a_data_set(tmp_path):
    soil = simulated()
    air = simulated(names=(*TABLE_A1, "CylStroke_1"))
    write_recording(soil, tmp_path / "a.parquet")
    write_recording(air, tmp_path / "b.parquet")
    read = read_data_set(tmp_path)
    assert [r.channel_names for r in read] == [(*TABLE_A1, "CylStroke_1")] * 2
    np.testing.assert_array_equal(read[0].values, soil.select([*TABLE_A1, "CylStroke_1"]))
    write_recording(simulated(names=("BmUp", "CylStroke_1")), tmp_path / "c.parquet")
    with pytest.raises(DataError, match=r"mixed channels: c\.parquet lacks"):
        read_data_set(tmp_path)
