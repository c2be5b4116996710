"""MDF 4 files written by asammdf itself, read by EDP."""

from __future__ import annotations

import struct
from xml.etree import ElementTree

import numpy as np
import pytest
from asammdf import MDF, Signal
from asammdf.blocks.conversion_utils import from_dict

from edp.errors import DataError
from edp.logs import LogEvent, Repair, inspect_log, read_parts, read_recording, write_recording, write_with_events
from edp.recording import Recording
from edp.signals import TABLE_A1, ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes


def signal(name, samples, stamps, unit="", **more):
    return Signal(samples=np.asarray(samples), timestamps=np.asarray(stamps), name=name, unit=unit, **more)


def save(path, *groups, compression=0):
    with MDF(version="4.10") as log:
        for name, signals in groups:
            log.append(signals, acq_name=name, common_timebase=True)
        log.save(path, overwrite=True, compression=compression)
    return path


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_groups_of_different_rates_share_the_grid_of_the_fastest(tmp_path, compression):
    fast, slow = np.arange(200) / 100, np.arange(40) / 20
    path = save(
        tmp_path / "a.mf4",
        ("Front", [signal("CylVels_1", fast * 1000, fast, "mm/s"), signal("BmUp", np.full(200, 20.0), fast, "bar")]),
        ("Slow", [signal("OilTemperature", 40 + slow, slow, "degC")]),
        compression=compression,
    )
    read = read_recording(path)
    assert read.channel_names == ("CylVels_1", "BmUp", "OilTemperature")
    assert read.rate_hz == 100.0
    np.testing.assert_allclose(read.column("CylVels_1"), fast[: read.samples], atol=1e-6)
    np.testing.assert_allclose(read.column("BmUp"), 2e6)
    # Held from the latest slow sample, never from a later one.
    np.testing.assert_allclose(read.column("OilTemperature")[:6], np.r_[[313.15] * 5, 313.2], atol=1e-3)


def test_conversions_integers_and_texts(tmp_path):
    time = np.arange(50) / 50
    raw = np.arange(50, dtype=np.uint16)
    scaled = signal("BmUp", raw, time, "bar", conversion=from_dict({"a": 0.5, "b": 10.0}))
    text = signal("mode", np.array([b"idle"] * 50), time, encoding="utf-8")
    path = save(tmp_path / "a.mf4", ("Bus", [scaled, text, signal("count", raw.astype(np.int64), time)]))
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "BmUp"), ChannelMap("n", "count"))))
    np.testing.assert_allclose(read.values[:, 0], (raw * 0.5 + 10.0) * 1e5)
    np.testing.assert_allclose(read.values[:, 1], raw)
    with pytest.raises(DataError, match="no column 'mode'"):
        read_recording(path, SignalMap((ChannelMap("m", "mode"),)))


def test_one_name_in_two_groups_and_units_is_never_chosen_silently(tmp_path):
    time = np.arange(20) / 10
    path = save(
        tmp_path / "a.mf4",
        ("Left", [signal("BmUp", np.full(20, 3.0), time, "bar"), signal("BmDwn", np.zeros(20), time, "bar")]),
        ("Right", [signal("BmUp", np.full(20, 4e5), time, "Pa")]),
    )
    with pytest.raises(DataError, match=r"2 columns named 'BmUp': Left.BmUp \[bar\], Right.BmUp \[Pa\]"):
        read_recording(path)
    findings = [finding.what for finding in inspect_log(path).findings]
    assert any("2 columns named 'BmUp'" in what for what in findings)
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "Left.BmUp"), ChannelMap("BmDwn", "Left.BmDwn"))))
    np.testing.assert_allclose(read.values, [[3e5, 0.0]] * 20)
    read = read_recording(path, SignalMap((ChannelMap("BmUp", "Right.BmUp"),)))
    np.testing.assert_allclose(read.values, 4e5)


def test_samples_marked_invalid_are_missing(tmp_path):
    time = np.arange(20) / 10
    invalid = np.zeros(20, dtype=bool)
    invalid[7] = True
    doubtful = signal("BmUp", np.arange(20.0), time, "bar", invalidation_bits=invalid)
    path = save(tmp_path / "a.mf4", ("Bus", [doubtful, signal("BmDwn", np.zeros(20), time)]))
    with pytest.raises(DataError, match=r"'BmUp' has 1 missing or infinite value\(s\), first in row 7"):
        read_recording(path)
    np.testing.assert_allclose(read_recording(path, repair=Repair(nan="hold")).column("BmUp")[6:9], [6e5, 6e5, 8e5])


def test_clock_that_runs_backwards(tmp_path):
    time = np.arange(40) / 10
    time[20:] -= 1.05
    path = save(tmp_path / "a.mf4", ("Bus", [signal("BmUp", np.arange(40.0), time)]))
    with pytest.raises(DataError, match=r"time goes back in 1 row\(s\), first in row 20"):
        read_recording(path)
    assert read_recording(path, repair=Repair(falling="sort")).samples >= 29


def test_parts_of_a_log_are_the_log(tmp_path):
    rng = np.random.default_rng(0)
    channels = tuple(TABLE_A1[name] for name in ("BmUp", "CylVels_1"))
    values = rng.standard_normal((1000, 2)).astype(np.float32)
    values[400:420, 1] = np.nan
    for suffix in (".mf4", ".mcap", ".parquet", ".csv"):
        path = write_recording(Recording("R", channels, values, 100.0), tmp_path / f"a{suffix}")
        whole = read_recording(path, repair=Repair(nan="hold"))
        parts = list(read_parts(path, samples=410, repair=Repair(nan="hold")))
        assert [part.name.rpartition("[")[2] for part in parts] == ["0:410]", "410:820]", "820:1000]"]
        np.testing.assert_array_equal(np.vstack([part.values for part in parts]), whole.values)
        assert [fact["row"] for part in parts for fact in part.meta.get("repairs", [])] == [400, 410]
    with pytest.raises(DataError, match="give at least 1"):
        next(read_parts(path, samples=0))


def test_files_that_cannot_be_read_say_why(tmp_path):
    time = np.arange(20) / 10
    path = save(tmp_path / "a.mf4", ("Bus", [signal("BmUp", np.arange(20.0), time)]))
    whole = bytearray(path.read_bytes())
    path.write_bytes(b"UnFinMF " + whole[8:])
    with pytest.raises(DataError, match="not closed by its logger"):
        read_recording(path)
    older = bytearray(whole)
    older[8:16] = b"3.30    "
    struct.pack_into("<H", older, 28, 330)
    path.write_bytes(older)
    with pytest.raises(DataError, match=r"MDF version 3.30; save it as MDF 4"):
        read_recording(path)
    path.write_bytes(whole[:-100])
    with pytest.raises(DataError, match="damaged MDF file"):
        read_recording(path)
    save(path, ("Bus", [signal("mode", np.array([b"idle"] * 20), time, encoding="utf-8")]))
    with pytest.raises(DataError, match="no channels of numbers; channels: mode, time"):
        read_recording(path)
    can = np.zeros(20, dtype=[("CAN_DataFrame.ID", "<u4"), ("CAN_DataFrame.DLC", "u1")])
    save(path, ("CAN", [signal("CAN_DataFrame", can, time)]))
    with pytest.raises(DataError, match=r"decode them with their database \(DBC, ARXML\)|none is in the built-in"):
        read_recording(path)


def test_values_changed_after_edp_wrote_them_are_refused(tmp_path):
    channels = (TABLE_A1["BmUp"],)
    path = write_recording(Recording("R", channels, np.ones((50, 1), dtype=np.float32), 10.0), tmp_path / "a.mf4")
    with MDF(path) as log:
        facts = log.extract_attachment(index=0)[0]
    with MDF(version="4.10") as log:
        log.append([signal("BmUp", np.full(50, 2, dtype=np.float32), np.arange(50) / 10)])
        log.attach(facts, file_name="edp_info.json")
        log.save(path, overwrite=True)
    with pytest.raises(DataError, match="not the ones that EDP wrote"):
        read_recording(path)


def test_a_map_may_take_the_file_by_kind_and_rows(tmp_path):
    time = np.arange(300) / 100
    path = save(tmp_path / "a.mf4", ("Bus", [signal("x", time, time), signal("y", 2 * time, time)]))
    wanted = SignalMap((ChannelMap("x", "x", "m", Kind.POSITION),), rate_hz=50.0)
    read = read_recording(path, wanted, rows=(10, 20))
    np.testing.assert_allclose(read.values[:, 0], np.arange(10, 20) / 50, atol=1e-6)


def test_events_lie_beside_the_signals_as_stretches_with_their_text(tmp_path):
    written = Recording("log", (TABLE_A1["BmUp"],), np.zeros((300, 1), np.float32), 100.0, "s", {})
    hostile = "a <b> & 'c' \u202e" + "x" * 5_000
    events = [LogEvent("head pressure of the boom", 0.5, 2.25, hostile), LogEvent("<EVcomment>", 2.5, 2.5)]
    path = write_with_events(written, tmp_path / "a.mf4", events)
    with MDF(path) as log:
        found = log.events
        assert [event.range_type for event in found] == [1, 2, 1, 2]
        assert [event.value for event in found] == pytest.approx([0.5, 2.25, 2.5, 2.5])
        assert [event.name for event in found] == [events[0].name] * 2 + ["<EVcomment>"] * 2
        assert found[1].range_start_ev_addr == found[0].address
        text = ElementTree.fromstring(found[0].comment).findtext("TX")
        assert text.startswith("a <b> & 'c'  xxx")
        assert len(text) == 2_000
    # The reader of logs takes such a file, and the signals are what they were.
    np.testing.assert_array_equal(read_recording(path).values, written.values)


@pytest.mark.parametrize(
    ("start_s", "end_s"), [(2.0, 1.0), (-1.0, 1.0), (0.0, float("nan")), (float("inf"), float("inf"))]
)
def test_events_that_are_no_stretch_are_refused(start_s, end_s):
    with pytest.raises(DataError, match="an end not before the start"):
        LogEvent("x", start_s, end_s)


def test_events_are_refused_where_a_file_cannot_hold_them(tmp_path):
    one = Recording("log", (TABLE_A1["BmUp"],), np.zeros((3, 1), np.float32), 100.0, "s", {})
    with pytest.raises(DataError, match=r"takes no events.*\.mf4"):
        write_with_events(one, tmp_path / "a.csv", [])
    with pytest.raises(DataError, match="at most"):
        write_with_events(one, tmp_path / "a.mf4", [LogEvent("x", 0.0, 0.0)] * 100_001)
    assert not list(tmp_path.iterdir())
