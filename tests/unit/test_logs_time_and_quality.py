"""The time rule, repairs and quality findings on small logs with known defects."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.logs import Repair, inspect, inspect_log, read_recording, split_at_gaps
from edp.logs.timebase import judge
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes


def log(tmp_path, time, values, name="a.csv", column="CylVels_1", digits=6):
    rows = "\n".join(f"{t:.{digits}f},{'' if np.isnan(v) else repr(float(v))}" for t, v in zip(time, values))
    path = tmp_path / name
    path.write_text(f"time,{column}\n{rows}\n")
    return path


def ramp(n):
    return np.arange(n) * 1e-3


def test_rounded_stamps_are_uniform_by_row(tmp_path):
    step = 1 / 128
    path = log(tmp_path, np.arange(4000) * step, ramp(4000), digits=2)
    assert inspect_log(path).errors == ()
    read = read_recording(path)
    assert read.samples == 4000
    assert read.rate_hz == pytest.approx(128, rel=1e-3)


def test_stamps_of_a_coarse_clock_are_uniform_by_row():
    """Whatever the step of the clock is: 0.3 to 0.8 of it off what is printed, and finer at the beginning."""
    time = np.arange(3000) / 4800
    stamps = np.where(time < 0.05, np.round(time, 4), 0.0003 + np.floor(time * 1000) / 1000)
    clock = judge(stamps, "a log")
    assert clock.uniform
    assert clock.rate_hz == pytest.approx(4800, rel=2e-3)


@pytest.mark.parametrize("hole", [40, 400])
def test_stamps_of_a_coarse_clock_with_rows_lost_are_not_uniform(hole):
    rows = np.delete(np.arange(3000), np.arange(1000, 1000 + hole))
    clock = judge(np.floor(rows / 4.8) / 1000, "a log")
    assert not clock.uniform


def test_rows_that_come_twice_are_not_a_coarse_clock():
    rows = np.sort(np.concatenate([np.arange(600), np.arange(100, 400)]))
    assert len(judge(rows / 100, "a log").duplicates) == 300


def test_small_jitter_is_uniform_and_keeps_every_row(tmp_path):
    rng = np.random.default_rng(0)
    time = np.arange(500) * 0.01 + rng.uniform(-3e-4, 3e-4, 500)
    read = read_recording(log(tmp_path, time, ramp(500)))
    assert read.rate_hz == 100.0
    assert "resampled_from_hz" not in read.meta
    np.testing.assert_array_equal(read.values[:, 0], ramp(500).astype(np.float32))


def test_large_jitter_is_resampled_to_the_latest_sample(tmp_path):
    rng = np.random.default_rng(0)
    time = np.round(np.arange(500) * 0.01 + rng.uniform(0, 8e-3, 500), 6)
    path = log(tmp_path, time, ramp(500))
    read = read_recording(path, SignalMap(rate_hz=100.0))
    ticks = time[0] + np.arange(read.samples) * 0.01
    expected = [ramp(500)[time <= tick + 1e-8][-1] for tick in ticks]
    np.testing.assert_array_equal(read.values[:, 0], np.float32(expected))
    assert any("not uniform" in finding.what for finding in inspect_log(path).findings)


def test_decimation_takes_every_tenth_row(tmp_path):
    read = read_recording(log(tmp_path, np.arange(1001) * 0.001, ramp(1001)), SignalMap(rate_hz=100.0))
    np.testing.assert_array_equal(read.values[:, 0], ramp(1001)[::10].astype(np.float32))


def test_one_lost_row_is_no_rounding(tmp_path):
    """A single row missing from exact stamps is held, it does not shift all later rows."""
    keep = np.delete(np.arange(300), 150)
    read = read_recording(log(tmp_path, keep * 0.01, ramp(300)[keep], digits=2))
    assert read.samples == 300
    np.testing.assert_array_equal(read.values[149:152, 0], np.float32([0.149, 0.149, 0.151]))


def with_gap():
    keep = np.r_[0:100, 160:300]
    return keep * 0.01, ramp(300)[keep]


def test_gap_is_refused_with_its_place_and_cure(tmp_path):
    path = log(tmp_path, *with_gap())
    with pytest.raises(DataError, match=r'1 gap\(s\) in time, first at row 101.*repair gaps = "hold"'):
        read_recording(path)
    finding = inspect_log(path).errors[0]
    assert "gaps in time" in finding.what
    assert finding.where == "after row 99 (t = 0.99 s)"


def test_gap_repairs(tmp_path):
    path = log(tmp_path, *with_gap())
    held = read_recording(path, repair=Repair(gaps="hold"))
    assert (held.samples, held.values[130, 0]) == (300, np.float32(0.099))
    assert held.meta["repairs"][0]["repair"] == "gaps = hold"
    cut = read_recording(path, repair=Repair(gaps="cut"))
    assert (cut.samples, cut.values[0, 0]) == (140, np.float32(0.16))
    kept = read_recording(path, repair=Repair(gaps="keep"))
    assert int(np.isnan(kept.values).sum()) == 59
    parts = split_at_gaps(kept)
    assert [part.samples for part in parts] == [101, 140]
    assert [part.name for part in parts] == ["a.0", "a.1"]
    assert split_at_gaps(held) == [held]


def test_gap_cut_with_a_constant_channel_and_rows(tmp_path):
    path = log(tmp_path, *with_gap())
    signal_map = SignalMap((ChannelMap("CylVels_1", "CylVels_1"), ChannelMap("BmUp", "", constant=0.0)))
    kept = read_recording(path, signal_map, repair=Repair(gaps="keep"))
    assert len(split_at_gaps(kept)) == 2
    # Rows that leave the gap out need no repair.
    assert read_recording(path, signal_map, rows=(0, 100)).samples == 100


def test_missing_values(tmp_path):
    values = ramp(100)
    values[[40, 41]] = np.nan
    path = log(tmp_path, np.arange(100) * 0.01, values)
    with pytest.raises(DataError, match=r"'CylVels_1' has 2 missing.*row 40 \(t = 0.4 s\).*nan = \"hold\""):
        read_recording(path)
    held = read_recording(path, repair=Repair(nan="hold"))
    np.testing.assert_array_equal(held.values[39:43, 0], np.float32([0.039, 0.039, 0.039, 0.042]))
    assert held.meta["repairs"] == [{"repair": "nan = hold", "channel": "CylVels_1", "count": 2, "row": 40}]
    values[0] = np.nan
    path = log(tmp_path, np.arange(100) * 0.01, values)
    # Nothing earlier can be held: the log starts where its values do, unless rows are named.
    assert read_recording(path, repair=Repair(nan="hold")).samples == 99
    with pytest.raises(DataError, match="start the rows at 1"):
        read_recording(path, rows=(0, None), repair=Repair(nan="hold"))
    assert read_recording(path, rows=(1, None), repair=Repair(nan="hold")).samples == 99


def test_values_too_large_for_float32_count_as_missing(tmp_path):
    path = log(tmp_path, np.arange(5) * 0.01, np.array([0, 1, 1e39, 3, 4.0]))
    with pytest.raises(DataError, match="1 missing or infinite"):
        read_recording(path)


def test_duplicate_and_falling_stamps(tmp_path):
    time = np.arange(60) * 0.01
    double = np.insert(time, 31, time[30])
    values = np.arange(61.0) * 1e-3
    path = log(tmp_path, double, values)
    with pytest.raises(DataError, match=r'1 duplicate time stamp\(s\), first in row 31.*duplicates = "last"'):
        read_recording(path)
    assert "duplicate" in inspect_log(path).errors[0].what
    mended = read_recording(path, repair=Repair(duplicates="last"))
    assert (mended.samples, mended.values[30, 0]) == (60, np.float32(0.031))
    swapped = time.copy()
    swapped[[20, 21]] = swapped[[21, 20]]
    path = log(tmp_path, swapped, ramp(60))
    with pytest.raises(DataError, match=r'time goes back in 1 row\(s\), first in row 21.*falling = "sort"'):
        read_recording(path)
    assert "goes back" in inspect_log(path).errors[0].what
    sorted_ = read_recording(path, repair=Repair(falling="sort"))
    assert sorted_.values[20:22, 0].tolist() == [np.float32(0.021), np.float32(0.020)]
    assert sorted_.meta["repairs"][0]["repair"] == "falling = sort"


def test_time_that_cannot_be_used(tmp_path):
    path = log(tmp_path, [0.0, 0.0, 0.0], [1.0, 2.0, 3.0])
    with pytest.raises(DataError, match="is this the time column"):
        read_recording(path)
    (tmp_path / "b.csv").write_text("time,CylVels_1\n0,1\n,2\n0.02,3\n")
    with pytest.raises(DataError, match="not finite, first in row 1"):
        read_recording(tmp_path / "b.csv")
    assert "not finite" in inspect_log(tmp_path / "b.csv").errors[0].what
    with pytest.raises(DataError, match="needs at least 2"):
        read_recording(log(tmp_path, [0.0], [1.0]))
    with pytest.raises(ConfigError, match="sample_time_s = 0; give a number"):
        SignalMap(sample_time_s=0.0)
    with pytest.raises(ConfigError, match="rate_hz = 0; give a number"):
        SignalMap(rate_hz=0.0)


def test_unknown_repair_is_refused():
    with pytest.raises(ConfigError, match="nan = 'drop' is not one of refuse, hold, keep"):
        Repair(nan="drop")


def quality(name, values, kind=None):
    channel = TABLE_A1[name] if kind is None else Channel(name, kind)
    return inspect(Recording("r", (channel,), np.float32(values).reshape(-1, 1), 100.0))


NOISE = np.random.default_rng(5).uniform(0.2, 1.0, 400)


@pytest.mark.parametrize(
    ("name", "values", "says", "kind"),
    [
        ("CylPressures_1", NOISE * 250, "looks like bar", None),
        ("BmUp", NOISE * 35, "looks like bar", None),
        ("CylVels_1", NOISE * 300, "looks like mm/s", None),
        ("CylAcc_1", NOISE * 3000, "looks like mm/s^2", None),
        ("angle", NOISE * 120, "looks like deg", Kind.ANGLE),
        ("speed", NOISE * 60, "looks like deg/s", Kind.ANGULAR_VELOCITY),
        ("oil", NOISE * 60, "looks like degC", Kind.TEMPERATURE),
        ("stroke", NOISE * 1500, "looks like mm", Kind.POSITION),
        ("CylVels_1", np.full(50, 0.02), "constant at 20 mm/s", None),
    ],
)
def test_odd_channels_are_named(name, values, says, kind):
    report = quality(name, values, kind)
    assert [finding.channel for finding in report.findings if says in finding.what] == [name]


def test_ordinary_channels_give_no_findings():
    swing = 0.6 + 0.3 * np.sin(np.arange(400) * 0.02) + 0.01 * NOISE
    for name, scale in (("CylPressures_1", 2e7), ("BmUp", 3e6), ("CylVels_1", 0.4), ("CylAcc_1", 8.0)):
        assert quality(name, swing * scale).findings == ()
    idle = np.concatenate([np.zeros(300), swing * 2e6, np.zeros(300)])
    assert quality("BmUp", idle).findings == ()


def test_stuck_run_is_a_note():
    swing = 0.5 * np.cos(np.arange(400) * np.pi / 400)
    values = np.concatenate([swing, np.full(250, -0.4), -swing])
    (finding,) = quality("CylVels_1", values).findings
    assert (finding.severity, finding.where) == ("note", "row 400 (t = 4 s)")
    assert "longest 2.5 s" in finding.what


def test_report_facts_are_in_report_units_and_json():
    values = np.array([293.15, 303.15, np.nan], dtype=np.float32)
    report = quality("oil", values, Kind.TEMPERATURE)
    facts = report.channels[0]
    assert (facts.unit, facts.missing) == ("degC", 1)
    assert (facts.min, facts.max, facts.std) == pytest.approx((20, 30, 5), abs=1e-3)
    assert report.errors[0].count == 1
    empty = quality("CylVels_1", [np.nan, np.nan]).to_json()
    assert json.loads(json.dumps(empty, allow_nan=False))["channels"][0]["min"] is None


def test_inspection_reports_instead_of_raising(tmp_path):
    path = log(tmp_path, np.arange(50) * 0.01, ramp(50), column="CylVel_1 [mm/s]")
    report = inspect_log(path)
    assert report.errors
    assert any("did you mean 'CylVels_1'" in finding.what for finding in report.findings)
    signal_map = SignalMap((ChannelMap("CylVels_1", "CylVel_1", "m/s"), ChannelMap("BmUp", "nothing")))
    report = inspect_log(path, signal_map)
    texts = [finding.what for finding in report.findings]
    assert any("no column 'nothing'" in text for text in texts)
    assert any("map says m/s, the file says mm/s" in text for text in texts)
    assert report.samples == 50
