"""Step, noise, update rate, clipping, frozen and spiking channels; repeated sessions; a channel in two units."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.logs import find_repeats, inspect, sketch, write_recording
from edp.logs.quality import columns
from edp.logs.quality.measures import measure, noise_floor
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind

RATE = 100.0


def motion(samples=12_000, seed=0, size=1.0):
    """A smooth random motion below 1 Hz, deviation `size`."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE
    parts = [np.sin(2 * np.pi * f * t + p) for f, p in zip(rng.uniform(0.03, 0.8, 12), rng.uniform(0, 6.3, 12))]
    made = np.sum(parts, axis=0)
    return size * made / made.std()


def noisy(seed=0, noise=0.01, **k):
    return motion(seed=seed, **k) + np.random.default_rng(seed + 100).normal(0, noise, k.get("samples", 12_000))


def report(values, kind=Kind.GENERIC, rate=RATE):
    return inspect(Recording("r", (Channel("x", kind),), np.float32(values).reshape(-1, 1), rate))


def only(values, kind=Kind.GENERIC):
    (finding,) = report(values, kind).findings
    return finding


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.3])
def test_noise_is_told_from_motion(noise):
    found = measure(np.float32(noisy(noise=noise)))
    assert found.noise == pytest.approx(noise, rel=0.1)
    assert found.busy
    assert found.quantum is None


def test_noise_of_motion_alone_is_nearly_nothing():
    assert noise_floor(np.float32(motion()))[0] < 1e-4


def test_a_good_channel_has_no_findings_and_its_facts():
    facts = report(noisy(noise=0.02) * 1e6 + 1e7, Kind.PRESSURE)
    assert facts.findings == ()
    (channel,) = facts.channels
    assert channel.verdict == facts.verdict == "good"
    assert channel.noise == pytest.approx(0.2, rel=0.1)  # bar
    assert channel.snr_db == pytest.approx(34, abs=1)
    assert channel.new_hz == RATE
    assert channel.step is None


@pytest.mark.parametrize("step", [0.5, 0.25])
def test_step_of_a_quantised_channel(step):
    values = np.round(motion() * 1e6 / (step * 1e6)) * step * 1e6 + 1e7
    facts = report(values, Kind.PRESSURE).channels[0]
    assert facts.step == pytest.approx(step * 10, rel=1e-5)  # bar
    finding = only(values, Kind.PRESSURE)
    assert f"quantised in steps of {step * 10:.4g} bar" in finding.what
    assert (finding.severity, facts.verdict) == ("warning", "check")


def test_fine_steps_offsets_and_scales_are_found_without_a_warning():
    rng = np.random.default_rng(1)
    raw = np.round(motion() * 400 + rng.normal(0, 1, 12_000))
    facts = report(np.float32(raw * 2441.40625 + 1e7), Kind.PRESSURE)
    assert facts.channels[0].step == pytest.approx(0.0244140625, rel=1e-4)
    assert facts.findings == ()


def test_float32_is_no_lattice():
    assert measure(np.float32(1e7 + motion(size=3.0))).quantum is None


def test_a_state_of_two_levels_is_not_coarse():
    assert report(motion() > 0, Kind.RATIO).findings == ()


@pytest.mark.parametrize(("every", "hz"), [(4, "25 Hz"), (2, "50 Hz")])
def test_channel_that_is_sent_more_slowly(every, hz):
    values = np.repeat(noisy(samples=12_000)[::every], every)
    finding = only(values)
    assert (finding.severity, hz in finding.what) == ("note", True)
    assert report(values).channels[0].new_hz == pytest.approx(RATE / every)


def test_thirty_hertz_on_a_grid_of_hundred():
    rows = (np.arange(12_000) * 0.3).astype(int)
    assert report(noisy()[rows]).channels[0].new_hz == pytest.approx(30, rel=0.01)


def test_frozen_sensor_also_at_zero():
    for held in (0.0, 0.37):
        values = noisy()
        values[5000:5100] = held
        finding = only(values)
        assert (finding.severity, finding.where) == ("warning", "row 5000 (t = 50 s)")
        assert "longest 1 s" in finding.what


def test_a_held_command_is_a_note_and_rest_at_zero_nothing():
    t = np.arange(12_000) / RATE
    command = np.clip(np.sin(2 * np.pi * 0.2 * t), 0, None)
    assert report(command * 2e6, Kind.PILOT_PRESSURE).findings == ()
    held = np.where((t > 51) & (t < 54), 0.5, command)
    assert only(held * 2e6, Kind.PILOT_PRESSURE).severity == "note"


def test_clipped_sensor():
    finding = only(np.minimum(noisy(noise=0.05), 1.0))
    assert finding.what.startswith("clipped at its upper end, 1, for ")
    assert finding.severity == "warning"


def test_noise_alone_and_spikes():
    assert "mostly noise" in only(np.random.default_rng(2).normal(size=12_000)).what
    values = noisy()
    values[[700, 3000, 5000]] += 30.0
    finding = only(values)
    assert (finding.severity, finding.count, finding.where) == ("warning", 3, "row 700 (t = 7 s)")


def test_copied_channel_is_named():
    values = np.float32(np.stack([noisy(), noisy(), np.zeros(12_000), np.zeros(12_000)], axis=1))
    recording = Recording("r", tuple(Channel(n, Kind.GENERIC) for n in "abcd"), values, RATE)
    assert [f.channel for f in inspect(recording).findings if f.what == "equals 'a' in every sample"] == ["b"]


def session(name, seed, samples=12_000):
    values = np.stack([noisy(seed=seed + i, samples=samples) * 0.1 for i in range(4)], axis=1)
    return Recording(name, tuple(TABLE_A1.values())[:4], np.float32(values), RATE)


OTHERS = [session("a", 10), session("b", 20), session("c", 30)]


def repeats(*more):
    return find_repeats([sketch(recording) for recording in (*OTHERS, *more)])


def test_different_sessions_do_not_repeat():
    assert repeats() == ()


def test_two_machines_driven_by_one_programme_are_no_repeat():
    """The command agrees in every window, what it drives in none."""
    commanded = session("other", 60).values.copy()
    commanded[:, :2] = OTHERS[0].values[:, :2]
    assert repeats(replace(OTHERS[0], name="other", values=commanded)) == ()


def test_steps_that_look_alike_now_and_then_are_no_repeat():
    """Every second window is that of another session."""
    mixed = OTHERS[0].values.copy()
    other = session("other", 70).values
    for start in range(0, 12_000, 2560):
        mixed[start : start + 1280] = other[start : start + 1280]
    assert repeats(replace(OTHERS[0], name="mixed", values=mixed)) == ()


def test_the_same_samples_under_another_name():
    (found,) = repeats(replace(OTHERS[1], name="copy"))
    assert (found.first, found.second, found.identical, found.share) == ("b", "copy", True, 1.0)


def test_copies_are_named_beside_the_first_and_repeat_others_once():
    copies = [sketch(replace(OTHERS[1], name=f"copy {number}")) for number in range(3)]
    part = sketch(replace(OTHERS[1], name="part", values=np.ascontiguousarray(OTHERS[1].values[2007:9007])))
    found = find_repeats([sketch(OTHERS[1]), *copies, part])
    pairs = {(repeat.first, repeat.second, repeat.identical) for repeat in found}
    assert pairs == {*(("b", copy.name, True) for copy in copies), ("b", "part", False)}
    assert len(found) == len(pairs)


def test_a_shifted_part_at_half_the_rate_and_another_scale():
    part = OTHERS[1].values[2007:9007:2] * 3.0 + 1.0
    (found,) = repeats(replace(OTHERS[1], name="part", values=np.ascontiguousarray(part), rate_hz=50.0))
    assert (found.first, found.second, found.identical) == ("b", "part", False)
    assert found.first_from_s == pytest.approx(20.07, abs=0.11)
    assert found.second_from_s == pytest.approx(0.0, abs=0.11)
    assert found.seconds == pytest.approx(70, abs=1)
    assert (found.channels, found.compared) == (4, 4)
    assert found.correlation > 0.99


def test_renamed_and_reordered_channels():
    names = tuple(Channel(f"s{i}", Kind.GENERIC) for i in range(4))
    order = [2, 0, 3, 1]
    renamed = replace(OTHERS[2], name="other", channels=names, values=OTHERS[2].values[1500:, order].copy())
    (found,) = repeats(renamed)
    assert (found.first, found.second) == ("c", "other")
    expected = {(OTHERS[2].channel_names[j], f"s{i}") for i, j in enumerate(order)}
    assert set(found.renamed) == expected
    assert "4 under other names" in found.what


def test_a_session_inside_another_with_other_noise():
    rng = np.random.default_rng(3)
    inside = OTHERS[0].values[3000:9000] + rng.normal(0, 0.005, (6000, 4)).astype(np.float32)
    values = np.concatenate([session("x", 40).values[:4000], inside, session("x", 50).values[:4000]])
    (found,) = repeats(replace(OTHERS[0], name="mixed", values=values))
    assert (found.first, found.second) == ("a", "mixed")
    assert found.seconds == pytest.approx(60, abs=14)


def test_a_recording_at_rest_votes_for_nothing():
    rest = replace(OTHERS[0], name="rest", values=np.ones_like(OTHERS[0].values))
    assert repeats(rest) == ()
    assert find_repeats([sketch(rest), sketch(replace(rest, name="shorter", values=rest.values[:9000]))]) == ()


@pytest.mark.long
def test_looking_for_repeats_holds_little_beside_the_sketches():
    """Fingerprints of all recordings at once would be as much as the sketches again and again."""
    sketches = [sketch(session(f"s{i}", 100 + 10 * i, samples=120_000)) for i in range(10)]
    held = sum(one.values.nbytes for one in sketches)
    tracemalloc.start()
    try:
        assert find_repeats(sketches) == ()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 5 * held


def test_columns_in_pieces_say_the_same(monkeypatch):
    recording = OTHERS[0]
    whole = inspect(recording), sketch(recording)
    monkeypatch.setattr(columns, "PIECE_BYTES", 1)  # a column at a time
    pieces = inspect(recording), sketch(recording)
    assert whole[0] == pieces[0]
    np.testing.assert_array_equal(whole[1].values, pieces[1].values)
    np.testing.assert_array_equal(np.stack(list(columns.columns(recording)), axis=1), recording.values)


@pytest.mark.processes
def test_data_set_tells_repeats_and_a_channel_in_two_units(tmp_path):
    pressures = [replace(entry, channels=(TABLE_A1["CylPressures_1"], *entry.channels[1:])) for entry in OTHERS]
    for entry in pressures:
        values = entry.values.copy()
        values[:, 0] = 1e7 + 2e7 * values[:, 0]
        if entry.name == "c":
            values[:, 0] /= 1e5
        write_recording(replace(entry, values=values), tmp_path / f"{entry.name}.parquet")
        if entry.name == "b":
            write_recording(replace(entry, values=values[500:9000].copy()), tmp_path / "again.csv")
    told = NotedProgress()
    quality = DataSource.from_path(tmp_path).inspect(told)
    assert told.stages == [("log", 4)]
    texts = [finding.what for finding in quality.findings]
    assert any("repeats 85 s of 'again'" in text or "repeats 85 s of 'b'" in text for text in texts)
    assert [f.where for f in quality.findings if "bar read as Pa?" in f.what] == ["c"]
    assert quality.verdict == "check"
    plain = json.loads(json.dumps(quality.to_json(), allow_nan=False))
    assert plain["repeats"][0]["channels"] == 4
    assert {report["verdict"] for report in plain["recordings"]} == {"good", "check"}
