"""Whether the parts of a split hold motion, and how the preset auto divides recordings that rest at one end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edp.data.even_split import blocks_of_motion, blocks_where_time_is_uneven, is_even, most_unlike, moving_ticks
from edp.data.splits import ByBlocks, ByName, ByRecording, ByTime
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.auto import load_auto
from edp.workflows.auto.recordings import divide
from edp.workflows.proposal import propose

RATE = 50.0


def recording(name, moves, seed=0):
    """A position that wanders where `moves`, seen by an encoder whose steps come and go at rest."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(-1, 1, len(moves) // 25 + 1), 25)[: len(moves)] * moves
    x = np.round(np.cumsum(speed) / RATE / 0.002 + rng.uniform(-0.5, 0.5, len(moves))) * 0.002
    values = np.float32(np.stack([speed, x], axis=1))
    return Recording(name, (Channel("u", Kind.GENERIC), Channel("x", Kind.GENERIC)), values, RATE)


def settings(*changes):
    return load_auto(None, ["task.targets=['x']", "task.horizons=[1, 10]", *changes])


RESTS_AT_ITS_END = np.arange(6000) < 3600
MOVES = np.ones(6000, dtype=bool)


def test_steps_of_an_encoder_are_no_motion():
    (moving,) = moving_ticks([recording("a", RESTS_AT_ITS_END)], ["x"], 10)
    assert moving[:3500].mean() > 0.5
    assert moving[3700:].mean() < 0.01


def test_a_recording_that_rests_at_its_end_is_divided_by_blocks():
    log = recording("a", RESTS_AT_ITS_END)
    divided, (words,) = divide([log], settings())
    assert isinstance(divided.split, ByBlocks)
    assert "rests" in words
    assert f"{divided.split.block_s:.3g} s" in words
    moving = moving_ticks([log], ["x"], 10)
    gap = 42
    assert is_even(divided.split, [log], gap, moving)
    assert not is_even(ByTime(), [log], gap, moving)


@pytest.mark.parametrize("moves", [MOVES, np.zeros(6000, dtype=bool)])
def test_any_other_recording_is_divided_by_time_as_before(moves):
    divided, words = divide([recording("a", moves)], settings())
    assert divided.split == ByTime()
    assert words == []


def test_a_split_that_was_asked_for_stays():
    asked = settings("split.kind='time'")
    assert divide([recording("a", RESTS_AT_ITS_END)], asked) == (asked, [])


def test_whole_recordings_stay_whole_where_each_moves():
    logs = [recording(name, RESTS_AT_ITS_END, seed) for seed, name in enumerate("abcdef")]
    divided, words = divide(logs, settings())
    assert isinstance(divided.split, ByRecording)
    assert words == []


def test_recordings_at_rest_are_not_what_tests():
    at_rest = np.zeros(6000, dtype=bool)
    drawn = ByName().split([recording(name, MOVES) for name in "abcdef"], 42)
    tests = {one.recording for one in drawn.test}
    logs = [recording(name, at_rest if i in tests else MOVES, i) for i, name in enumerate("abcdef")]
    divided, _ = divide(logs, settings())
    moving = moving_ticks(logs, ["x"], 10)
    assert not isinstance(divided.split, ByRecording)
    assert is_even(divided.split, logs, 42, moving)


def test_missing_values_and_channels_are_no_motion():
    log = recording("a", MOVES)
    log.values[100:200] = np.nan
    (moving,) = moving_ticks([log], ["x", "absent"], 10)
    assert len(moving) == 6000
    other = replace(recording("b", MOVES), channels=(Channel("u", Kind.GENERIC), Channel("y", Kind.GENERIC)))
    assert all(one.all() for one in moving_ticks([log, other], ["x"], 10))


def test_blocks_are_longer_than_their_gaps():
    short = recording("a", MOVES[:600])
    assert blocks_of_motion([short], 42).block_s * RATE >= 8 * 42


def test_a_recording_whose_end_rests_is_given_the_blocks_that_training_takes():
    log = recording("a", RESTS_AT_ITS_END)
    blocks, _ = blocks_where_time_is_uneven([log], ["x"], [1, 10], ByTime())
    assert blocks == divide([log], settings())[0].split
    assert blocks_where_time_is_uneven([recording("b", MOVES)], ["x"], [1, 10], ByTime()) is None


def sweep(name, last_hz, ticks=6000):
    """A position that swings at 0.5 Hz first and at another frequency last."""
    hertz = np.geomspace(0.5, last_hz, ticks)
    values = np.sin(2 * np.pi * np.cumsum(hertz) / RATE)
    return Recording(name, (Channel("x", Kind.GENERIC),), values[:, None].astype(np.float32), RATE)


@pytest.mark.parametrize(("last_hz", "ratio"), [(8.0, 2.0), (0.12, 0.5)])
def test_a_sweep_is_divided_by_blocks_and_says_by_what(last_hz, ratio):
    logs = [sweep("a", last_hz), sweep("b", last_hz, 5000)]
    furthest, name, span = most_unlike(ByTime(), logs, 42, ["x"], [1])
    assert (name, span) == ("x", 1)
    assert (furthest > ratio) if ratio > 1 else (furthest < ratio)
    blocks, why = blocks_where_time_is_uneven(logs, ["x"], [1], ByTime())
    assert "changes of x in 1 tick are" in why
    assert abs(np.log(most_unlike(blocks, logs, 42, ["x"], [1])[0])) < abs(np.log(furthest)) / 2
    divided, (words,) = divide(logs[:1], settings("task.horizons=[1]"))
    assert isinstance(divided.split, ByBlocks)
    assert "moves unlike the rest" in words


def test_a_recording_in_which_everything_changes_once_stays_divided_by_time():
    late = recording("a", np.ones(6000, dtype=bool))
    late.values[5000:, 1] *= 50.0
    late.values[4990:, 1] += np.linspace(0, 3000, 1010).astype(np.float32)
    blocks = blocks_of_motion([late], 42)
    assert most_unlike(ByTime(), [late], 42, ["x"], [1, 10])[0] > 2
    assert abs(np.log(most_unlike(blocks, [late], 42, ["x"], [1, 10])[0])) > np.log(2)
    assert divide([late], settings())[0].split == ByTime()


def test_missing_values_and_what_stands_still_are_alike():
    log = sweep("a", 0.5)
    log.values[::7] = np.nan
    assert most_unlike(ByTime(), [log], 42, ["x"], [1])[0] == pytest.approx(1.0, abs=0.1)
    still = replace(log, values=np.zeros_like(log.values))
    assert most_unlike(ByTime(), [still], 42, ["x", "absent"], [1]) == (1.0, "", 0)
    still.values[5500] = 1.0
    assert most_unlike(ByTime(), [still], 42, ["x"], [1]) == (np.inf, "x", 1)


@pytest.mark.processes
def test_the_proposal_for_two_sweeps_is_blocks(tmp_path):
    for name in "ab":
        log = sweep(name, 8.0)
        table = np.column_stack([np.arange(6000) / RATE, log.values])
        np.savetxt(tmp_path / f"{name}.csv", table, "%.6g", ",", header="time,x_pos", comments="")
    found = propose(tmp_path)
    assert 'kind = "blocks"' in found.files["settings.toml"]
    assert any("moves unlike the rest" in note for note in found.notes)


@pytest.mark.processes
def test_the_proposal_for_a_log_that_rests_at_its_end_is_blocks(tmp_path):
    log = recording("a", RESTS_AT_ITS_END)
    table = np.column_stack([np.arange(6000) / RATE, log.values])
    np.savetxt(tmp_path / "a.csv", table, "%.6g", ",", header="time,u_valve,x_pos", comments="")
    settings_text = propose(tmp_path / "a.csv").files["settings.toml"]
    assert 'kind = "blocks"' in settings_text
