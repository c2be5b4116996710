"""MAT files of Simulink's streamed logging and of System Identification Toolbox."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording
from edp.logs.formats.matlab.library import MatlabOpaque, matio
from edp.signals import ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes

ALL = SignalMap(others=True)


def text(value: str) -> np.ndarray:
    return np.array([value])


def struct(**fields: object) -> np.ndarray:
    made = np.empty((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        made[0, 0][name] = value
    return made


def element(
    name: str, block: str, record: float, times: object, width: int = 1, of_class: str = "double"
) -> np.ndarray:
    nothing = np.empty((0, 0))
    values = struct(
        ElementType=text("timeseries"),
        Name=text(name),
        TimeUnits=struct(Class=text("char"), Value=text("seconds")),
        DataUnits=struct(Class=text("char"), Value=text("deg")),
        DataR2=np.array([[record]]),
        CompressedTime=times if isinstance(times, np.ndarray) else nothing,
        TimeR2=np.array([[times]]) if isinstance(times, float) else nothing,
        SignalAttributes=struct(
            ClassName=text(of_class),
            ResolvedClassName=text(""),
            Dimension=np.array([[width]]),
            Complexity=np.array([[False]]),
        ),
    )
    return struct(
        ElementType=text("signal"), Name=text(name), BlockPath=text(block), PortIndex=np.array([[1.0]]), Values=values
    )


def streamed(path: Path, elements: list[np.ndarray], records: dict[int, np.ndarray]) -> Path:
    cell = np.empty((1, len(elements)), dtype=object)
    for i, one in enumerate(elements):
        cell[0, i] = one
    storage = MatlabOpaque({"any": struct(Elements=cell)}, "Simulink.SimulationData.Storage.MatFileDatasetStorage")
    data = MatlabOpaque({"any": struct(Name=text("data"), Storage=storage)}, "Simulink.SimulationData.Dataset")
    matio.save_to_mat(str(path), {"data": data}, version="v7.3")
    with h5py.File(path, "r+") as stored:
        group = stored.create_group("#sigstream#")
        group["#nRecords#"] = np.array([len(records)], dtype=np.uint64)
        for number, samples in records.items():
            record = group.create_group(str(number))
            record["#data#"] = np.frombuffer(samples.tobytes(), dtype=np.uint8)
            record["#length#"] = np.array([len(samples)], dtype=np.uint64)
            record["#sampleSize#"] = np.array([samples.itemsize * samples[0].size], dtype=np.uint64)
    return path


EVEN, HALF = np.array([[0.0, 0.01, 40.0]]), np.array([[0.0, 0.02, 20.0]])
ANGLE = np.linspace(-70.0, -60.0, 40)


def test_streamed_signals_of_two_rates_a_vector_and_times_of_their_own(tmp_path):
    lever = np.sin(np.arange(20.0)).astype(np.float32)
    elements = [
        element("boomAngle", "Model/Add", 5.0, EVEN),
        element("boomAngle", "Model/Scope", 6.0, EVEN),
        element("lever", "Model/Stick", 7.0, HALF, of_class="single"),
        element("uneven", "Model/Add1", 8.0, 9.0, width=2),
    ]
    pairs = np.arange(80.0).reshape(40, 2)
    records = {5: ANGLE, 6: ANGLE, 7: lever, 8: pairs, 9: 0.01 * np.arange(40)}
    read = read_recording(streamed(tmp_path / "a.mat", elements, records), ALL)
    # The copy at the other block is the same signal.
    assert set(read.channel_names) == {"boomAngle", "lever", "uneven_1", "uneven_2"}
    assert read.rate_hz == 100.0
    assert np.allclose(read.column("boomAngle"), np.radians(ANGLE[: read.samples]))
    assert np.allclose(read.column("lever")[:6], np.radians(np.repeat(lever, 2)[:6]))
    assert np.allclose(read.column("uneven_2")[:5], np.radians(pairs[:5, 1]))


def test_streamed_signals_of_one_name_are_told_apart_by_their_block(tmp_path):
    elements = [element("x", "Model/In", 1.0, EVEN), element("x", "Model/Out", 2.0, EVEN)]
    read = read_recording(streamed(tmp_path / "a.mat", elements, {1: ANGLE, 2: 2 * ANGLE}), ALL)
    assert read.channel_names == ("Model/In:1.x", "Model/Out:1.x")


@pytest.mark.parametrize(
    ("records", "times", "message"),
    [
        ({2: ANGLE}, EVEN, r"'x' refers to a record 1, which is not there"),
        ({1: ANGLE[:30]}, EVEN, r"'x' has 30 samples and 40 times"),
        ({1: ANGLE}, np.array([[0.0, 0.01, 1e30]]), r"'x' has 40 samples and 1000000"),
    ],
)
def test_damaged_streams_are_one_error(tmp_path, records, times, message):
    path = streamed(tmp_path / "a.mat", [element("x", "Model/In", 1.0, times)], records)
    with pytest.raises(DataError, match=message):
        read_recording(path, ALL)


@pytest.mark.parametrize("record", [float("nan"), float("inf"), -1.0, 1e300])
def test_a_reference_to_no_record_is_one_error(tmp_path, record):
    path = streamed(tmp_path / "a.mat", [element("x", "Model/In", record, EVEN)], {1: ANGLE})
    with pytest.raises(DataError, match="damaged"):
        read_recording(path, ALL)


def test_a_stream_that_announces_more_than_it_has(tmp_path):
    path = streamed(tmp_path / "a.mat", [element("x", "Model/In", 1.0, EVEN, width=3)], {1: ANGLE})
    with pytest.raises(DataError, match="announces 40 samples, its record has 320 bytes"):
        read_recording(path, ALL)


def iddata(outputs: object, inputs: object) -> MatlabOpaque:
    data = MatlabOpaque(
        {"Ts": np.array([[20.0]]), "Tstart": np.empty((0, 0)), "SamplingInstants": np.empty((0, 0))}
        | {"OutputData": outputs, "InputData": inputs},
        "idpack.iodata.TimeIOData",
    )
    names = {"InputName_": np.array([["valve"]]), "OutputName_": np.array([["pressure"]])}
    units = {"OutputUnit_": np.array([["bar"]]), "InputUnit_": np.empty((0, 1)), "TimeUnit_": text("milliseconds")}
    return MatlabOpaque(names | units | {"Data_": data}, "iddata")


def test_iddata_has_its_names_units_and_time(tmp_path):
    y, u = 100 + np.arange(50.0).reshape(-1, 1), np.ones((50, 1))
    matio.save_to_mat(str(tmp_path / "a.mat"), {"z": iddata(y, u)})
    pressure = ChannelMap("p", "pressure", None, Kind.PRESSURE)
    read = read_recording(tmp_path / "a.mat", SignalMap((pressure,), others=True))
    assert read.rate_hz == 50.0
    assert read.column("p")[3] == np.float32(103e5)
    assert np.all(read.column("valve") == 1)


def test_iddata_of_several_experiments_says_how_to_part_it(tmp_path):
    cell = np.empty((1, 2), dtype=object)
    cell[0, 0] = cell[0, 1] = np.ones((50, 1))
    matio.save_to_mat(str(tmp_path / "a.mat"), {"z": iddata(cell, cell)})
    with pytest.raises(DataError, match=r"2 experiments in one iddata.*getexp"):
        read_recording(tmp_path / "a.mat", ALL)
