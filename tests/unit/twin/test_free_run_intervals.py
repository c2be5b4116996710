"""Intervals of free runs: that they hold what they promise, and grow."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.evaluation.free_run import FreeRunJudgeSpec, FreeRuns, calibrated, coverage_of, free_run_scores, free_runs
from edp.networks.twin import FreeRunIntervals, calibrate
from edp.networks.twin.static_map import StaticMap
from edp.settings.results import plain_value
from edp.storage.seals import HASH, content_digest
from edp.testing.twins import sample_series, sample_twin
from edp.training.twin_bundle import HEADER, TwinBundle, load_twin, save_twin

TICKS = 400


def wandering(runs, rng):
    """Errors of three answers that add up, stay, and are rarely large, with a size of its own in each run."""
    size = rng.lognormal(0, 0.5, (runs, 1, 1))
    steps = rng.normal(size=(runs, TICKS, 3))
    return size * np.stack([steps[..., 0].cumsum(axis=1), steps[..., 1], rng.standard_t(3, (runs, TICKS))], axis=2)


@pytest.mark.long
@pytest.mark.parametrize("coverage", [0.5, 0.9])
def test_fresh_runs_lie_in_them_as_often_as_promised_at_each_horizon(coverage):
    rng = np.random.default_rng(0)
    intervals = calibrate(wandering(400, rng).astype(np.float32), coverage)
    at = np.array([1, 2, 10, 100, TICKS])
    inside = np.abs(wandering(3000, rng)[:, at - 1]) <= intervals.at(at)
    # Three deviations of a quantile of 400 runs.
    np.testing.assert_allclose(inside.mean(axis=0), coverage, atol=3 * (coverage * (1 - coverage) / 400) ** 0.5)
    assert intervals.runs == 400
    assert intervals.ticks[0] == 1
    assert intervals.ticks[-1] == TICKS


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30), st.integers(1, 300), st.floats(0.05, 0.95), st.integers(0, 99))
def test_they_never_shrink_and_hold_their_own_runs(runs, ticks, coverage, seed):
    errors = np.random.default_rng(seed).standard_cauchy((runs, ticks, 2)).astype(np.float32)
    intervals = calibrate(errors, coverage)
    half = intervals.at(np.arange(1, 2 * ticks + 2))
    assert (np.diff(half, axis=0) >= 0).all()
    assert np.array_equal(half[ticks - 1 :], np.repeat(half[ticks - 1 : ticks], ticks + 2, axis=0))
    if runs < coverage / (1 - coverage):  # too few runs for the promise: the largest error of those around a horizon
        assert half[-1] == pytest.approx(intervals.half_width[-1])
        assert intervals.half_width.max() == pytest.approx(np.abs(errors).max(), rel=1e-6) or ticks > 1


def test_few_runs_give_the_largest_error():
    assert calibrate(np.float32([[[1.0]], [[-3.0]], [[2.0]]]), 0.9).half_width.tolist() == [[3.0]]
    assert calibrate(np.arange(19, dtype=np.float32).reshape(19, 1, 1), 0.9).half_width.tolist() == [[17.0]]


def test_runs_that_end_early_calibrate_the_horizons_that_they_reach():
    rng = np.random.default_rng(1)
    whole = wandering(60, rng).astype(np.float32)
    cut = whole.copy()
    cut[20:, 50:] = np.nan
    half, short, few = (calibrate(errors, 0.9).at(np.arange(1, TICKS + 1)) for errors in (cut, whole, whole[:20]))
    np.testing.assert_allclose(half[:20], short[:20], rtol=0.2)  # far from where knots mix
    np.testing.assert_allclose(half[200:], few[200:], rtol=0.2)
    assert calibrate(cut, 0.9).runs == 60


def test_a_short_stretch_calibrates_short_horizons_by_more_starts_than_fit_a_long_run():
    twin, series = twin_and_series()
    short = [replace(part, inputs=part.inputs[:60], targets=part.targets[:60]) for part in series[1:4]]
    spec = FreeRunJudgeSpec(duration_s=60.0, calibration_starts=8)
    intervals = calibrated([(twin, short)], spec)
    assert intervals.ticks[-1] == 60 - 10 - 1
    assert 50 < intervals.runs <= 3 + 3 * 3 * 8  # but for starts beyond an end stop
    assert (
        calibrated([(twin, short)], replace(spec, duration_s=0.9)).runs <= 3 * 5
    )  # as long as asked: nothing is added


def twin_and_series():
    return sample_twin(StaticMap(prefix_ticks=10))[0], sample_series(16)[1]


def test_those_of_a_twin_hold_on_recordings_that_calibrated_nothing():
    twin, series = twin_and_series()
    spec = FreeRunJudgeSpec(duration_s=5.0, calibration_starts=20, coverage_at_s=(0.1, 1.0, 5.0, 60.0))
    intervals = calibrated([(twin, series[1:9])], spec)
    runs = free_runs(twin, series[9:], 5.0, 20)
    scores = plain_value(free_run_scores(runs, spec, intervals).intervals)
    assert [row["at_s"] for row in scores["at"]] == [0.1, 1.0, 5.0]
    assert all(0.75 <= row[part]["share"] <= 1.0 for row in scores["at"] for part in ("velocities", "strokes"))
    assert scores["calibrated_by"] > 80
    assert scores["coverage"] == 0.9
    first, last = (row["strokes"]["half_width"] for row in (scores["at"][0], scores["at"][-1]))
    assert last["mean"] > 3 * first["mean"]
    assert first["unit"] == "mm"


def test_coverage_is_counted_by_channel_and_time():
    twin, _ = twin_and_series()
    channels = twin.channels
    truth = np.zeros((4, 20, 6), np.float32)
    answers = truth.copy()
    answers[:3, :, 0] = 2.0  # beyond the interval of 1 in three runs of four
    answers[0, 10:, 2] = 2.0  # beyond it later, in one run
    intervals = FreeRunIntervals(0.9, (1, 10), np.ones((2, 6), np.float32), 5)
    runs = FreeRuns(channels, tuple("abcd"), answers, truth, truth[:, 0], -np.ones(6), np.ones(6))
    rows = plain_value(coverage_of(runs, FreeRunJudgeSpec(coverage_at_s=(0.1, 0.4)), intervals))["at"]
    assert [row["calibrated"] for row in rows] == [True, False]
    assert rows[0]["velocities"]["by_channel"] == {"speed_1": 0.25, "speed_2": 1.0}
    assert rows[0]["velocities"]["share"] == 0.625
    assert [row["strokes"]["by_channel"]["stroke_1"] for row in rows] == [1.0, 0.75]


def test_they_come_back_with_the_twin_and_earlier_twins_have_none(tmp_path):
    twin, series = twin_and_series()
    intervals = calibrated([(twin, series[:2])], FreeRunJudgeSpec(duration_s=2.0))
    save_twin(TwinBundle(StaticMap(prefix_ticks=10), twin, intervals=intervals), tmp_path)
    loaded = load_twin(tmp_path).intervals
    assert loaded.to_dict() == intervals.to_dict()
    save_twin(TwinBundle(StaticMap(prefix_ticks=10), twin), tmp_path)
    assert load_twin(tmp_path).intervals is None
    header = json.loads((tmp_path / HEADER).read_text())
    header = {key: value for key, value in header.items() if key not in ("intervals", HASH)} | {"schema": 1}
    (tmp_path / HEADER).write_text(json.dumps(header | {HASH: content_digest(header)}))
    assert load_twin(tmp_path).intervals is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ticks": (2, 1)}, "do not grow"),
        ({"ticks": (1,)}, "1 horizons and widths of shape"),
        ({"coverage": 1.5}, "cannot be"),
        ({"runs": True}, "cannot be"),
        ({"ticks": (1, 10**12)}, "cannot be"),
        ({"half_width": np.float32([[2, 2], [1, 2]])}, "shrink with the horizon"),
        ({"half_width": np.float32([[1, np.nan], [1, 2]])}, "are no numbers"),
        ({"half_width": np.float32([[-1, 1], [1, 2]])}, "shrink with the horizon, or"),
    ],
)
def test_intervals_that_cannot_be_are_refused(changes, message):
    sound = FreeRunIntervals(0.9, (1, 5), np.float32([[1, 1], [1, 2]]), 4)
    with pytest.raises(ValueError, match=message):
        replace(sound, **changes)
