"""`Stream` in Python keeps the rules of the exported C: the same status, counts and numbers for any order of calls."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.errors import ConfigError, DataError
from edp.export.c.target import CTarget
from edp.export.golden import random_inputs, tolerance
from edp.export.golden import stream as in_one_piece
from edp.networks.input_range import HOLD_TICKS, input_limits
from edp.networks.stream import Stream, StreamStatus

STEP, MISSED, RESET = range(3)
BAD = (np.nan, np.inf, -np.inf, 3.3e38, -3.3e38)
DRIVER = Path(__file__).with_name("stream_driver.c")


def calls_of(predictor, count, seed):
    """Steps, some with bad inputs and some in a row, missed ticks and resets: ``(call, ticks, inputs)``."""
    rng = np.random.default_rng(seed)
    rows = random_inputs(predictor, count, seed)
    low, high = input_limits(predictor)
    calls, bad_left = [], 0
    for row in rows:
        draw = rng.random()
        if draw < 0.02:
            calls.append((RESET, 0, row))
        elif draw < 0.12:
            calls.append((MISSED, int(rng.choice([1, 2, HOLD_TICKS - 1, HOLD_TICKS, HOLD_TICKS + 1, 4000])), row))
        else:
            bad_left = int(rng.integers(1, 2 * HOLD_TICKS)) if draw < 0.16 else bad_left
            if bad_left:
                bad_left -= 1
                place = rng.integers(len(row))
                row[place] = rng.choice([*BAD, np.float32(2 * high[place]), np.float32(2 * low[place])])
            calls.append((STEP, 0, row))
    return calls


def in_python(predictor, calls):
    stream, status, counts, numbers = Stream(predictor), [], [], []
    empty = np.full(stream.step(calls[0][2]).prediction.size, np.nan)
    stream.reset()
    tick = None
    for call, ticks, row in calls:
        if call == RESET:
            stream.reset()
            tick = None
        else:
            tick = stream.step(row) if call == STEP else stream.missed(ticks)
        status.append(0 if tick is None else int(tick.status))
        counts.append((stream.ticks, stream.rejected, stream.held, stream.restarts))
        numbers.append(empty if tick is None else tick.prediction.ravel())
        if tick is not None and tick.coverages:
            numbers[-1] = np.concatenate([numbers[-1], tick.lower.ravel(), tick.upper.ravel()])
    width = max(len(row) for row in numbers)
    return status, counts, np.array([row if len(row) == width else np.full(width, np.nan) for row in numbers])


@pytest.fixture(scope="module")
def in_c(c, bundle_of, tmp_path_factory):
    """What the exported C says of the same calls."""
    c.need("gcc")

    def run(structure, whole, calls, numbers):
        folder = tmp_path_factory.mktemp("rules")
        CTarget().write(bundle_of(structure, whole), "predictor", folder)
        (folder / "driver.c").write_text(DRIVER.read_text())
        c.run("gcc", "-std=c99", "-O1", "-ffp-contract=off", "driver.c", *c.sources(folder), "-lm", "-o", "driver",
              folder=folder)  # fmt: skip
        feed = b"".join(
            np.array([call, ticks], "<u4").tobytes() + row.astype("<f4").tobytes() for call, ticks, row in calls
        )
        said = np.frombuffer(
            c.run(folder / "driver", feed=feed), dtype=np.dtype([("said", "<u4", 5), ("out", "<f4", numbers)])
        )
        return said["said"][:, 0].tolist(), [tuple(row) for row in said["said"][:, 1:].tolist()], said["out"]

    return run


@pytest.mark.parametrize(
    ("network", "whole"),
    [("hybrid+all", False), ("tcn+quantiles", False), ("hybrid+all", True), ("lstm+quantiles", True)],
)
def test_python_and_c_keep_the_same_rules(network, whole, bundle_of, in_c):
    predictor = bundle_of(network, whole).predictor
    calls = calls_of(predictor, 1_500, seed=3)
    status, counts, numbers = in_python(predictor, calls)
    c_status, c_counts, c_numbers = in_c(network, whole, calls, numbers.shape[1])
    assert status == c_status
    assert counts == c_counts
    assert {*status} == {*map(int, StreamStatus)}
    finite = np.isfinite(numbers)
    np.testing.assert_array_equal(finite, np.isfinite(c_numbers))
    assert finite.mean() > 0.9
    # Restarts draw other states than one long stream: the tolerance of the golden recording, and half of it more.
    golden = random_inputs(predictor, 500, seed=1)
    allowed = 1.5 * tolerance(predictor, golden, in_one_piece(predictor, golden))
    far = np.abs(np.where(finite, numbers - c_numbers, 0.0)).max(axis=0)
    assert (far <= allowed).all(), far / np.maximum(allowed, 1e-30)


def test_one_bad_tick_is_held_and_does_not_poison_the_later_ones(bundle_of):
    predictor = bundle_of("hybrid").predictor
    rows = random_inputs(predictor, 60, seed=4)
    stream = Stream(predictor)
    for row in rows[:30]:
        before = stream.step(row)
    spoilt = rows[30].copy()
    spoilt[1] = np.nan
    tick = stream.step(spoilt)
    assert (before.status, tick.status, tick.valid) == (StreamStatus.OK, StreamStatus.HELD, True)
    other = Stream(predictor)
    for row in [*rows[:30], rows[29]]:
        same = other.step(row)
    np.testing.assert_array_equal(tick.prediction, same.prediction)  # held: the last accepted inputs again
    for row in rows[31:]:
        tick = stream.step(row)
    assert np.isfinite(tick.prediction).all()
    assert (stream.rejected, stream.held, stream.restarts, stream.ticks) == (1, 1, 0, 60)


def test_a_tick_gives_prediction_intervals_and_flags_at_once(bundle_of):
    predictor = bundle_of("tcn+quantiles").predictor
    rows = random_inputs(predictor, 20, seed=4)
    stream = Stream(predictor)
    ticks = [stream.step(row) for row in rows]
    assert stream.ticks == len(rows)
    found = np.array([np.concatenate([t.prediction.ravel(), t.lower.ravel(), t.upper.ravel()]) for t in ticks])
    np.testing.assert_allclose(found, in_one_piece(predictor, rows), rtol=2e-4, atol=2e-5)
    assert [tick.status for tick in ticks] == [StreamStatus.WARMING] * 8 + [StreamStatus.OK] * 12
    lower, upper = ticks[-1].interval(ticks[-1].coverages[0])
    assert (lower < upper).all()
    with pytest.raises(ConfigError, match=r"no interval of coverage 0\.123"):
        ticks[-1].interval(0.123)


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        ([0.0] * 3, r"shape \(3,\); \(5,\) must hold.*CylVels_1"),
        ([[0.0] * 5], r"shape \(1, 5\)"),
        (["a"] * 5, "takes 5 numbers"),
        (None, "shape|takes 5 numbers"),
        ([1 + 2j] * 5, "takes 5 numbers"),
        ([[0.0], [1.0, 2.0]], "takes 5 numbers"),
    ],
)
def test_inputs_that_are_no_tick_are_refused_and_change_nothing(inputs, words, bundle_of):
    predictor = bundle_of("hybrid").predictor
    assert len(predictor.task.inputs) == 5
    stream = Stream(predictor)
    with pytest.raises(DataError, match=words):
        stream.step(inputs)
    assert stream.ticks == 0
    with pytest.raises(DataError, match="at least 1"):
        stream.missed(0)
    with pytest.raises(ConfigError, match="at least 1"):
        Stream(predictor, threads=0)


def test_a_network_that_overflows_restarts(bundle_of):
    predictor = copy.deepcopy(bundle_of("tcn").predictor)  # the networks are shared between tests
    stream = Stream(predictor)
    rows = random_inputs(predictor, 12, seed=1)
    for row in rows:
        good = stream.step(row)
    with torch.no_grad():
        predictor.code.width.fill_(torch.inf)
    tick = stream.step(rows[0])
    assert tick.status is StreamStatus.RESTARTED
    assert not tick.valid
    np.testing.assert_array_equal(tick.prediction, good.prediction)  # left as it was
    assert stream.restarts == 1
    assert not stream.warm


@pytest.mark.parametrize("asked", [1, 2])
def test_a_tick_runs_on_the_threads_asked_for_and_gives_them_back(asked, bundle_of, monkeypatch):
    predictor = bundle_of("hybrid").predictor
    before, seen = torch.get_num_threads(), []
    plain = predictor.predict_with_intervals

    def watched(x, state):
        seen.append(torch.get_num_threads())
        return plain(x, state)

    monkeypatch.setattr(predictor, "predict_with_intervals", watched)
    try:
        torch.set_num_threads(3)
        Stream(predictor, threads=asked).step(random_inputs(predictor, 1, seed=0)[0])
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert seen == [asked]


def test_a_prediction_that_was_given_does_not_change_later(bundle_of):
    predictor = bundle_of("hybrid").predictor
    stream = Stream(predictor)
    rows = random_inputs(predictor, 30, seed=2)
    first = stream.step(rows[0])
    kept = first.prediction.copy()
    for row in rows[1:]:
        stream.step(row)
    np.testing.assert_array_equal(first.prediction, kept)
    assert dataclasses.is_dataclass(first)
