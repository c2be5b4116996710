"""Channels, kinds, units, names and recordings: the words that every room uses."""

import math
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, DataError, closest
from edp.logs.read import read_recording
from edp.logs.source import DataSource
from edp.logs.units import channel_from_entry
from edp.recording import Recording
from edp.registry import Registry
from edp.settings.tree import plain_tree
from edp.signals import EXTRA_CHANNELS, KINDS, TABLE_A1, UNITS, Channel, ChannelMap, Kind, SignalMap, conversion
from edp.workflows.live.sources.udp import _conversions


def test_table_a1_has_the_24_names_in_its_order():
    names = list(TABLE_A1)
    assert len(names) == 24
    assert names[:3] == ["CylVels_1", "CylVels_2", "CylVels_3"]
    assert names[6:12] == [f"CylPressures_{i}" for i in (1, 2, 3, 5, 6, 7)]
    assert names[-1] == "BktOutConf"
    assert not set(TABLE_A1) & set(EXTRA_CHANNELS)


def test_every_kind_has_facts_and_its_si_unit_converts_by_one():
    assert set(KINDS) == set(Kind)
    for kind, facts in KINDS.items():
        unit = conversion(facts.si_unit, kind, "here")
        assert (unit.factor, unit.offset) == (1.0, 0.0)
        low, high = facts.plausible
        assert low < high
        assert facts.nominal > 0


@pytest.mark.parametrize(
    ("unit", "kind", "value", "si"),
    [
        ("mm/s", Kind.VELOCITY, 1500.0, 1.5),
        ("bar", Kind.PRESSURE, 350.0, 35e6),
        ("psi", Kind.PILOT_PRESSURE, 14.503773773, 1e5),
        ("deg", Kind.ANGLE, 180.0, math.pi),
        ("rpm", Kind.ANGULAR_VELOCITY, 60.0, 2 * math.pi),
        ("L/min", Kind.FLOW, 60.0, 1e-3),
        ("degF", Kind.TEMPERATURE, 212.0, 373.15),
        ("degC", Kind.TEMPERATURE, -273.15, 0.0),
        ("%", Kind.RATIO, 50.0, 0.5),
        ("g", Kind.ACCELERATION, 1.0, 9.80665),
    ],
)
def test_units(unit, kind, value, si):
    found = conversion(unit, kind, "here")
    assert value * found.factor + found.offset == pytest.approx(si, rel=1e-9, abs=1e-9)


def test_units_that_do_not_fit_are_refused_with_what_does():
    with pytest.raises(ConfigError, match=r"a\.csv.*'bar' does not measure 'velocity'.*mm/s"):
        conversion("bar", Kind.VELOCITY, "a.csv")
    with pytest.raises(ConfigError, match=r"unknown unit 'mm/sec'.*did you mean 'mm/s'"):
        conversion("mm/sec", Kind.VELOCITY, "a.csv")
    assert all(unit.kinds for unit in UNITS.values())


def test_report_units_invert_to_si():
    for kind, facts in KINDS.items():
        if facts.report_unit in UNITS and kind is not Kind.TEMPERATURE:
            assert conversion(facts.report_unit, kind, "").factor * facts.report_factor == pytest.approx(1.0)


def test_map_entries_take_the_kind_of_the_vocabulary_or_their_own():
    assert channel_from_entry(ChannelMap("CylVels_1", "v")) is TABLE_A1["CylVels_1"]
    assert channel_from_entry(ChannelMap("Load", "F", kind=Kind.FORCE)) == Channel("Load", Kind.FORCE)
    assert channel_from_entry(ChannelMap("x", "x")).kind is Kind.GENERIC
    with pytest.raises(ConfigError, match=r"names channel.*twice: a"):
        SignalMap((ChannelMap("a", "x"), ChannelMap("a", "y")))


@pytest.mark.processes
@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_a_map_tells_the_kind_that_an_entry_leaves_out(unit, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,F\n" + "".join(f"{0.01 * k:.2f},{k}\n" for k in range(50)))
    signal_map = SignalMap((ChannelMap("Load", "F", unit=unit),))
    recording = read_recording(log, signal_map)
    channel = recording.channels[0]
    assert channel.kind in UNITS[unit].kinds
    assert (channel.kind is Kind.GENERIC) == (unit == "1")
    assert recording.column("Load")[7] == pytest.approx(7 * UNITS[unit].factor + UNITS[unit].offset)
    # A live row with the same map has the same value.
    assert _conversions(signal_map)("Load", {"F": 7.0}) == pytest.approx(float(recording.column("Load")[7]))


@pytest.mark.processes
def test_numbers_stay_as_they_are_where_the_map_says_generic_or_the_unit_has_no_kind(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,F\n" + "".join(f"{0.01 * k:.2f},{k}\n" for k in range(50)))
    for entry in (ChannelMap("Load", "F", "kN", Kind.GENERIC), ChannelMap("Load", "F", "kW"), ChannelMap("Load", "F")):
        recording = read_recording(log, SignalMap((entry,)))
        assert (recording.channels[0].kind, float(recording.column("Load")[7])) == (Kind.GENERIC, 7.0)


def test_models_of_earlier_versions_read_logs_as_they_were_trained():
    signal_map = SignalMap((ChannelMap("Load", "F", unit="kN"), ChannelMap("CylVels_1", "v", unit="mm/s")))
    source = DataSource(Path("log.csv"), signal_map)
    again = DataSource.from_dict(source.to_dict()).signal_map
    assert [channel_from_entry(entry).kind for entry in again.channels] == [Kind.FORCE, Kind.VELOCITY]
    before = DataSource.from_dict({"path": "log.csv", "map": plain_tree(signal_map)}).signal_map
    assert [channel_from_entry(entry).kind for entry in before.channels] == [Kind.GENERIC, Kind.VELOCITY]


def test_closest_names():
    assert closest("CylVel_1", TABLE_A1) == "; did you mean 'CylVels_1'?"
    assert closest("QUICK", ["quick", "thesis"]) == "; did you mean 'quick'?"
    assert closest("zzz", ["b", "a"]) == "; known: a, b"
    assert closest("zzz", []) == ""
    assert closest("zzz", [f"name{i:02d}" for i in range(20)]).endswith("name11, ...")


def test_registry_refuses_duplicates_and_helps_with_misses():
    parts = Registry("part")
    first = parts.register("first")(object())
    with pytest.raises(ConfigError, match="part 'first' is registered twice"):
        parts.register("first")(object())
    with pytest.raises(ConfigError, match="unknown part 'frist'; did you mean 'first'"):
        parts["frist"]
    assert parts.name_of(first) == "first"
    with pytest.raises(ConfigError, match="not a registered part"):
        parts.name_of(object())
    assert (list(parts), len(parts), "first" in parts, "second" in parts) == (["first"], 1, True, False)


def recording(values, names=("a", "b"), rate_hz=100.0, name="drive"):
    return Recording(name, tuple(Channel(n, Kind.GENERIC) for n in names), values, rate_hz)


def test_recordings():
    values = np.arange(20, dtype=np.float32).reshape(10, 2)
    drive = recording(values)
    assert (drive.samples, drive.duration_s, drive.channel_names) == (10, pytest.approx(0.1), ("a", "b"))
    assert drive.column("b").tolist() == values[:, 1].tolist()
    assert drive.select(["b", "a"])[3].tolist() == [7.0, 6.0]
    assert drive.rows(2, 5, "part").values.tolist() == values[2:5].tolist()
    with pytest.raises(DataError, match="drive"):
        drive.column("c")


def test_digests_follow_the_content():
    values = np.arange(20, dtype=np.float32).reshape(10, 2)
    same = recording(values.copy()).digest
    assert recording(values).digest == same
    changed = values.copy()
    changed[3, 1] += 1
    assert recording(changed).digest != same
    assert recording(values, names=("a", "c")).digest != same
    assert recording(values, rate_hz=50.0).digest != same


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": np.zeros((3, 3), np.float32)},
        {"values": np.zeros(3, np.float32)},
        {"values": np.zeros((3, 2), np.float32), "rate_hz": 0.0},
        {"values": np.zeros((3, 2), np.float32), "names": ("a", "a")},
    ],
)
def test_recordings_that_cannot_be(wrong):
    with pytest.raises(DataError):
        recording(**wrong)
