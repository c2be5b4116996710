"""Arrays and frames as recordings, and back."""

import sys

import numpy as np
import pandas as pd
import polars as pl
import pytest

import edp
from edp.errors import ConfigError, DataError
from edp.logs import write_recording

FRAMES = {"pandas": pd.DataFrame, "polars": pl.DataFrame}


def from_arrays(arrays, **options):
    return edp.Recordings.from_arrays(arrays, **{"rate_hz": 100.0, **options})


def test_units_are_converted_and_tell_the_kind(rig):
    first = rig[0]
    assert [(c.name, str(c.kind), c.unit) for c in first.channels] == [
        ("lever", "ratio", "1"),
        ("speed", "velocity", "m/s"),
    ]
    assert np.abs(first.column("lever")).max() <= 1
    assert rig.units == {"lever": "1", "speed": "m/s"}
    assert (rig.rate_hz, rig.names, len(rig)) == (100.0, ("lever", "speed"), 4)


@pytest.mark.parametrize(
    ("name", "unit", "kind", "value"),
    [
        ("whatever ü", None, "generic", 3.0),
        ("torque", "Nm", "generic", 3.0),
        ("CylVels_1", "mm/s", "velocity", 0.003),
        ("BmUp", "bar", "pilot_pressure", 3e5),
        ("BmUp", "V", "voltage", 3.0),
        ("BmUp", "kW", "generic", 3.0),
        ("oil", "°C", "temperature", 276.15),
        ("x", "%", "ratio", 0.03),
    ],
)
def test_any_name_and_any_known_unit_are_taken(name, unit, kind, value):
    (recording,) = from_arrays(np.full((4, 1), 3.0), names=[name], units=None if unit is None else [unit])
    assert str(recording.channels[0].kind) == kind
    np.testing.assert_allclose(recording.values, value, rtol=1e-6)
    if kind == "generic" and unit:
        assert recording.channels[0].description == f"in {unit}"


def test_one_array_is_one_recording_and_three_axes_are_several():
    assert len(from_arrays(np.zeros((5, 2)))) == 1
    assert from_arrays(np.zeros((3, 5, 2))).recording_names == ("recording_0", "recording_1", "recording_2")
    assert from_arrays(np.zeros((5, 2))).names == ("channel_0", "channel_1")


@pytest.mark.parametrize(
    ("arrays", "options", "message"),
    [
        ([], {}, "no arrays given"),
        ([np.zeros(5)], {}, r"array 0 has shape \(5,\); \(time, channel\) must hold.*column_stack"),
        ([np.zeros((0, 2))], {}, r"array 0 has shape \(0, 2\)"),
        ([np.zeros((5, 2)), np.zeros((5, 3))], {}, r"array 1 has shape \(5, 3\); 2 channels must hold"),
        ([np.full((5, 2), "a")], {}, "array 0 holds <U1; numbers must hold"),
        ([np.array([[1.0, np.nan], [1.0, 1.0]])], {}, "'channel_1' has 1 missing or infinite value"),
        ([np.array([[1.0, np.inf], [1.0, 1.0]])], {}, "missing or infinite"),
        ([np.zeros((5, 2))], {"names": ["a"]}, "names has 1 entries for 2 channels"),
        ([np.zeros((5, 2))], {"names": "ab"}, "names must be a list of texts"),
        ([np.zeros((5, 2))], {"names": ["a", "a"]}, "'a' occurs twice"),
        ([np.zeros((5, 2))], {"names": ["a", ""]}, "one is empty"),
        ([np.zeros((5, 2))], {"units": ["m"]}, "units has 1 entries for 2 channels"),
        ([np.zeros((5, 2))], {"units": {"chanel_0": "m"}}, "no channel 'chanel_0'; did you mean 'channel_0'"),
        ([np.zeros((5, 2))], {"units": [1, "m"]}, "that of 'channel_0' is no text"),
        ([np.zeros((5, 2))], {"recording_names": ["a", "b"]}, "recording_names has 2 entries for 1 recordings"),
        ([np.zeros((5, 2))], {"rate_hz": 0}, "rate_hz = 0; give the samples per second, a number above 0"),
        ([np.zeros((5, 2))], {"rate_hz": float("nan")}, "rate_hz = nan"),
        ([np.zeros((5, 2))], {"rate_hz": "100"}, "rate_hz = '100'"),
        (5, {}, "arrays is a int; give a list of arrays"),
        ([[[1.0, 2.0], [3.0]]], {}, r"array 0 is no array \(time, channel\)"),
    ],
)
def test_what_cannot_be_recordings_is_one_error(arrays, options, message):
    with pytest.raises(DataError, match=message):
        from_arrays(arrays, **options)


def test_missing_values_are_mended_where_asked_for():
    values = np.array([[1.0], [np.nan], [3.0]])
    held = from_arrays([values], repair={"nan": "hold"})
    assert held[0].values.ravel().tolist() == [1.0, 1.0, 3.0]
    assert np.isnan(from_arrays([values], repair={"nan": "keep"})[0].values[1, 0])
    with pytest.raises(ConfigError, match="repair"):
        from_arrays([values], repair={"nan": "holds"})


@pytest.mark.parametrize("library", FRAMES)
def test_frames_go_in_and_out(rig, library):
    frames = getattr(rig, f"to_{library}")()
    assert all(isinstance(frame, FRAMES[library]) for frame in frames)
    again = edp.Recordings.from_frames(frames, units=rig.units, recording_names=rig.recording_names)
    assert again.rate_hz == 100.0
    assert again.names == rig.names
    for before, after, values in zip(rig, again, rig.to_numpy(), strict=True):
        np.testing.assert_array_equal(after.values, before.values)
        np.testing.assert_array_equal(after.values, values)


@pytest.mark.parametrize("library", FRAMES)
def test_a_frame_has_a_rate_or_time_stamps(library):
    frame = FRAMES[library]({"a": [1.0, 2.0, 3.0]})
    assert edp.Recordings.from_frames(frame, rate_hz=10).rate_hz == 10
    with pytest.raises(DataError, match=r"no column of time stamps.*give rate_hz"):
        edp.Recordings.from_frames(frame)
    stamped = FRAMES[library]({"time": pd.date_range("2026-01-01", periods=3, freq="20ms").to_numpy(), "a": [1, 2, 3]})
    assert edp.Recordings.from_frames([stamped]).rate_hz == 50.0


def test_frames_that_cannot_be_are_one_error():
    with pytest.raises(DataError, match="frame 0 is a int; give a pandas or Polars DataFrame"):
        edp.Recordings.from_frames([5], rate_hz=1)
    with pytest.raises(DataError, match="no frames given"):
        edp.Recordings.from_frames([], rate_hz=1)
    with pytest.raises(DataError, match="column 0 is not named by a text"):
        edp.Recordings.from_frames(pd.DataFrame(np.zeros((3, 1))), rate_hz=1)
    with pytest.raises(DataError, match="column 'a' occurs twice"):
        edp.Recordings.from_frames(pd.DataFrame(np.zeros((3, 2)), columns=["a", "a"]), rate_hz=1)
    with pytest.raises(DataError, match="missing"):
        edp.Recordings.from_frames(pl.DataFrame({"a": [1, None, 3]}), rate_hz=1)
    with pytest.raises(DataError, match="no column of numbers"):
        edp.Recordings.from_frames(pd.DataFrame({"a": ["x", "y"]}), rate_hz=1)


def test_a_library_that_is_not_installed_is_named(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(ConfigError, match=r"polars is not installed; install it \(pip install polars\)"):
        rig.to_polars()


def test_sequences_of_recordings(rig):
    assert [recording.name for recording in rig] == list(rig.recording_names)
    assert isinstance(rig[1:3], edp.Recordings)
    assert rig[1:3].recording_names == ("recording_1", "recording_2")
    assert rig["recording_2"] is rig[2]
    with pytest.raises(DataError, match="no recording 'recording_9'"):
        rig["recording_9"]
    with pytest.raises(DataError, match="no recordings are left"):
        rig[4:]
    with pytest.raises(IndexError):
        rig[4]


def test_recordings_that_do_not_belong_together_are_refused(rig):
    other = from_arrays(np.zeros((5, 2)), recording_names=["other"])
    with pytest.raises(DataError, match=r"'lever' \(1\) is 'channel_0' \(1\) there"):
        edp.Recordings([*rig, *other])
    slow = from_arrays(np.zeros((5, 2)), names=["lever", "speed"], units=["%", "mm/s"], rate_hz=50)
    with pytest.raises(DataError, match="mixed rates"):
        edp.Recordings([*rig[1:], *slow])
    with pytest.raises(DataError, match="occur twice"):
        edp.Recordings([*rig, *rig])


def test_splits_are_drawn_and_disjoint(rig):
    train, test = rig.split(test=0.25, seed=3)
    assert (len(train), len(test)) == (3, 1)
    assert {*train.recording_names} | {*test.recording_names} == {*rig.recording_names}
    assert rig.split(0.25, 3)[1].recording_names == test.recording_names
    before, after = rig[:1].split(test=0.1)
    assert (before[0].samples, after[0].samples) == (360, 40)
    for share in (0.0, 1.0, float("nan")):
        with pytest.raises(ConfigError, match="test = "):
            rig.split(test=share)


def test_logs_are_read_with_a_map_and_without(tmp_path):
    rows = "".join(f"{t / 50:.2f};{t}.5;7\n" for t in range(20))
    (tmp_path / "a.csv").write_text(f"time;v_cyl [mm/s];u\n{rows}", encoding="utf-8")
    whole = edp.read(tmp_path / "a.csv")
    assert whole.names == ("v_cyl", "u")
    assert whole.units == {"v_cyl": "m/s", "u": "1"}
    assert whole.rate_hz == 50.0
    table = {"channels": {"velocity": {"column": "v_cyl", "kind": "velocity"}}}
    assert edp.read(tmp_path / "a.csv", map=table).names == ("velocity",)
    with pytest.raises(DataError, match="does not exist"):
        edp.read(tmp_path / "b.csv")
    with pytest.raises(ConfigError, match="map"):
        edp.read(tmp_path / "a.csv", map={"chanels": {}})


def test_what_edp_wrote_is_read_back(rig, tmp_path):
    for recording in rig:
        write_recording(recording, tmp_path / f"{recording.name}.parquet")
    again = edp.read(tmp_path)
    assert [recording.digest for recording in again] == [recording.digest for recording in rig]


def test_notebook_display_escapes_names():
    hostile = "<script>alert(1)</script>\u202e"
    data = from_arrays(np.zeros((5, 1)), names=[hostile], recording_names=["<img src=x>"], units=["m"])
    shown = data._repr_html_()
    for mark in ("<script", "<img", "\u202e"):
        assert mark not in shown
    assert "&lt;script&gt;" in shown
    text = data.plot().to_json()
    assert "\\u003cscript" not in text
    assert "<script" not in text
    assert "\u202e" not in repr(data)


def test_plots_draw_the_channels_asked_for(rig):
    figure = rig.plot("recording_1", channels=["speed"])
    assert len(figure.data) == 1
    np.testing.assert_allclose(figure.data[0].y, 1e3 * rig[1].column("speed"), rtol=1e-5)
    assert len(rig.plot().data) == 2
    with pytest.raises(DataError, match="no channel 'sped'; did you mean 'speed'"):
        rig.plot(channels=["sped"])
