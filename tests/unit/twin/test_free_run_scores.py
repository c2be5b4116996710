"""Scores of free runs, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from sample_scores import sample_errors, sample_free_run_scores

from edp.data.twin_channels import TwinChannels
from edp.errors import DataError
from edp.evaluation.ahead import look_ahead, predictor_scores, score_ahead
from edp.evaluation.free_run import FreeRunJudgeSpec, FreeRuns, free_run_scores, free_runs
from edp.evaluation.guard import twin_beaten_by
from edp.networks.twin.static_map import StaticMap
from edp.settings.results import plain_value
from edp.signals import Channel, Kind
from edp.testing.twins import sample_actuators, sample_twin

VELOCITIES = (Channel("v1", Kind.VELOCITY), Channel("v2", Kind.VELOCITY))
STROKES = (Channel("x1", Kind.POSITION), Channel("x2", Kind.POSITION))
PRESSURES = (Channel("p", Kind.PRESSURE), Channel("still", Kind.PRESSURE))
COMMAND = (Channel("u", Kind.RATIO),)


def ends(channels, stroke):
    """Bounds of the answers: velocities of 100, strokes of that length."""
    size = np.full(len(channels.answers), 100, np.float32)
    high = np.where(np.arange(len(size)) >= len(channels.velocities), stroke / 2, size)
    return -high, high


def at(*seconds):
    return FreeRunJudgeSpec(at_s=seconds)


def runs(velocities=VELOCITIES, strokes=STROKES, pressures=PRESSURES):
    """Two runs of four ticks at 2 Hz: velocity 1 is off by 3 mm/s, stroke 2 by 1, 2, 3, 4 mm, pressure by 1 Pa."""
    channels = TwinChannels(COMMAND, velocities, strokes, pressures, 2.0)
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(2, 4, len(channels.answers))).astype(np.float32)
    truth[..., -1] = 5.0
    answers = truth.copy()
    answers[..., 0] += np.array([3e-3, 3e-3, -3e-3, 3e-3])
    answers[..., 3] += 1e-3 * np.arange(1, 5)
    answers[..., 4] += 1.0
    return FreeRuns(channels, ("a", "b"), answers, truth, truth[:, 0], *ends(channels, 10))


def test_errors_by_kind_and_time():
    scores = plain_value(free_run_scores(runs(), at(0.5, 2.0, 60.0)))
    assert scores["velocity_mae"]["unit"] == "mm/s"
    assert scores["velocity_mae"]["by_channel"] == pytest.approx({"v1": 3.0, "v2": 0.0}, abs=1e-3)
    assert scores["velocity_mae"]["mean"] == pytest.approx(1.5, abs=1e-3)
    rows = {row["at_s"]: row for row in scores["stroke_error"]}
    assert set(rows) == {0.5, 2.0}
    assert rows[0.5]["by_channel"] == pytest.approx({"x1": 0.0, "x2": 1.0}, abs=1e-3)
    assert rows[2.0]["mean"] == pytest.approx(2.0, abs=1e-3)
    assert scores["pressure_nrmse"]["by_channel"]["p"] == pytest.approx(1 / runs().truth[..., 4].std(), rel=1e-4)
    assert scores["pressure_nrmse"]["by_channel"]["still"] is None
    assert scores["diverged"] == 0.0
    assert (scores["runs"], scores["recordings"], scores["seconds"]) == (2, 2, 2.0)


def test_without_strokes_velocities_are_integrated():
    channels = TwinChannels(COMMAND, VELOCITIES[:1], (), (), 2.0)
    truth = np.zeros((1, 4, 1), np.float32)
    answers = truth + np.float32(0.01)
    scores = plain_value(
        free_run_scores(FreeRuns(channels, ("a",), answers, truth, truth[:, 0], *ends(channels, 1)), at(2.0))
    )
    # Trapezoid of 0, 10, 10, 10, 10 mm/s over steps of 0.5 s.
    assert scores["stroke_error"][0]["mean"] == pytest.approx(17.5, rel=1e-5)
    assert scores["stroke_error"][0]["unit"] == "mm"


def test_a_run_astray_counts_as_diverged_and_so_does_one_without_a_number():
    astray, nothing = runs(), runs()
    astray.answers[1, 2, 2] += 100.0
    nothing.answers[0, 0, 4] = np.nan
    assert astray.diverged().tolist() == [False, True]
    assert nothing.diverged().tolist() == [True, False]


def test_what_rests_in_all_runs_is_not_astray_by_a_small_error():
    channels = TwinChannels(COMMAND, VELOCITIES, (), (), 2.0)
    truth = np.zeros((1, 40, 2), np.float32)
    truth[..., 0] = np.sin(np.arange(40))
    answers = truth.copy()
    answers[..., 1] += 1.0  # 20 m in 20 s, of 100 m in a second at full speed
    low, high = ends(channels, 1)
    assert not FreeRuns(channels, ("a",), answers, truth, truth[:, 0], low, high).diverged().any()
    # Of 10 m in a second half is exceeded.
    assert FreeRuns(channels, ("a",), answers, truth, truth[:, 0], low / 10, high / 10).diverged().all()


def test_units_are_never_mixed():
    mixed = (Channel("v1", Kind.VELOCITY), Channel("w", Kind.ANGULAR_VELOCITY))
    strokes = (Channel("x1", Kind.POSITION), Channel("q", Kind.ANGLE))
    scores = plain_value(free_run_scores(runs(mixed, strokes), at(1.0)))
    assert scores["velocity_mae"]["mean"] is None
    assert scores["velocity_mae"]["by_channel"]["v1"] == pytest.approx(3.0, abs=1e-3)
    assert scores["stroke_error"][0]["median"] is None


def test_runs_are_what_the_twin_answers_from_even_starts():
    twin, _, _ = sample_twin(StaticMap(prefix_ticks=40), sample_actuators(ticks=1200))
    recording, task = sample_actuators(ticks=1200), twin.channels.task()
    series = [task.series(recording, at, at + 600, f"part_{at}") for at in (0, 600)]
    result = free_runs(twin, series, 2.0, 3)
    assert result.names == ("part_0",) * 3 + ("part_600",) * 3
    assert result.answers.shape == (6, 100, 6)
    at = (600 - 141) // 2 + 40
    state = twin.reset(series[1].inputs[None, at - 40 : at], series[1].targets[None, at - 40 : at])
    expected, _ = twin.rollout(series[1].inputs[None, at : at + 100], state)
    np.testing.assert_allclose(result.answers[4], expected[0], rtol=1e-4, atol=1e-6)
    assert np.array_equal(result.truth[4], series[1].targets[at + 1 : at + 101])
    with pytest.raises(DataError, match="the longest recording has 30 ticks"):
        free_runs(twin, [task.series(sample_actuators(ticks=30))], 2.0, 3)


def test_starts_beyond_an_end_stop_are_left_out():
    twin, _, _ = sample_twin(StaticMap(prefix_ticks=10))
    low, high = twin.scales.low[2], twin.scales.high[2]
    within = twin.channels.task().series(sample_actuators())
    beyond = replace(within, name="beyond", targets=within.targets + np.float32([0, 0, high - low, 0, 0, 0]))
    assert set(free_runs(twin, [within, beyond], 1.0, 5).names) == {"actuators_0"}
    high_starts = replace(within, targets=within.targets + np.float32([0, 0, 3 * (high - low), 0, 0, 0]))
    with pytest.raises(DataError, match="all 5 starts lie beyond an end stop"):
        free_runs(twin, [high_starts], 1.0, 5)


def test_errors_by_horizon_recording_and_way_of_driving():
    scores = plain_value(free_run_scores(runs(), at(0.5), labels={"a": "dig", "b": "grade"}))
    assert scores["by_horizon"]["seconds"] == [0.5, 1.0, 1.5, 2.0]
    assert scores["by_horizon"]["strokes"]["by_channel"]["x2"] == pytest.approx([1.0, 2.0, 3.0, 4.0], abs=1e-3)
    assert scores["by_horizon"]["velocities"]["mean"] == pytest.approx([1.5] * 4, abs=1e-3)
    assert scores["by_horizon"]["pressures"]["unit"] == "bar"
    assert list(scores["by_recording"]) == ["a", "b"]
    assert scores["by_recording"]["b"]["velocity_mae"]["by_channel"]["v1"] == pytest.approx(3.0, abs=1e-3)
    assert scores["by_recording"]["b"]["stroke_error"][-1]["by_channel"]["x2"] == pytest.approx(4.0, abs=1e-3)
    # The verdict compares recordings at the times at which it compares all of them.
    assert {row["at_s"] for row in scores["stroke_error"]} <= {
        row["at_s"] for row in scores["by_recording"]["b"]["stroke_error"]
    }
    assert scores["by_driving"]["grade"] == scores["by_recording"]["b"]
    assert free_run_scores(runs(), at(0.5), labels={"a": "dig"}).by_driving == {}


def test_errors_at_end_stops_at_rest_and_in_motion():
    channels = TwinChannels(COMMAND, VELOCITIES, STROKES, PRESSURES[:1], 2.0)
    truth = np.zeros((1, 4, 5), np.float32)
    truth[0, :, 0] = [0.5, 0.0, 0.0, 50.0]  # the fastest is 100
    truth[0, :, 1] = [50.0, 50.0, 0.0, 50.0]
    truth[0, 0, 2] = 5.0  # the open end stop
    truth[0, :, 4] = [1.0, -1.0, 1.0, -1.0]
    answers = truth + np.float32([1e-3, 2e-3, 3e-3, 4e-3, 0.5])
    answers[0, 2, 0] += 1.0
    found = plain_value(
        free_run_scores(FreeRuns(channels, ("a",), answers, truth, truth[:, 0], *ends(channels, 10)), at(0.5))
    )
    rows = found["situations"]
    assert {name: (row["share"], row["machine_share"]) for name, row in rows.items()} == {
        "end_stops": (0.125, 0.25),
        "rest": (0.375, 0.25),
        "motion": (0.5, 0.5),
    }
    assert rows["end_stops"]["velocity_mae"]["by_channel"] == {"v1": pytest.approx(1.0, rel=1e-3), "v2": None}
    assert rows["rest"]["velocity_mae"]["by_channel"] == {
        "v1": pytest.approx((2 + 1000) / 2, rel=1e-3),
        "v2": pytest.approx(2.0, rel=1e-3),
    }
    assert rows["motion"]["stroke_error"]["by_channel"]["x2"] == pytest.approx(4.0, rel=1e-3)
    assert rows["motion"]["pressure_nrmse"]["by_channel"]["p"] == pytest.approx(0.5)


def test_a_look_ahead_is_measured_up_to_its_moment_and_told_the_commands_after_it():
    twin, _, _ = sample_twin(StaticMap(prefix_ticks=10))
    series = [twin.channels.task().series(sample_actuators(seed=seed)) for seed in (1, 2)]
    ahead = look_ahead(twin, series, 7, first=100)
    counts = [len(at) for at in ahead.moments]  # those whose prefix begins beyond an end stop are left out
    assert ahead.answers.shape == (sum(counts), 6)
    assert min(ahead.moments[1]) >= 100
    assert max(ahead.moments[1]) <= 600 - 7 - 1
    at, part = int(ahead.moments[1][50]), series[1]
    state = twin.reset(part.inputs[None, at - 10 : at], part.targets[None, at - 10 : at])
    _, state = twin.step(part.inputs[None, at], state, part.targets[None, at])
    expected, _ = twin.rollout(part.inputs[None, at + 1 : at + 7], state)
    place = counts[0] + 50
    np.testing.assert_allclose(ahead.answers[place], expected[0, -1], rtol=1e-4, atol=1e-6)
    assert np.array_equal(ahead.truth[place], part.targets[at + 7])
    scores = plain_value(score_ahead(ahead))
    errors = np.abs(ahead.answers - ahead.truth).mean(axis=0)
    assert scores["velocity_mae"]["mean"] == pytest.approx(1e3 * errors[:2].mean(), rel=1e-4)
    assert scores["stroke_error"]["by_channel"]["stroke_2"] == pytest.approx(1e3 * errors[3], rel=1e-4)
    assert (scores["seconds"], scores["moments"]) == (0.14, sum(counts))
    beside = plain_value(predictor_scores(ahead, {"speed_2": ahead.truth[:, 1] + np.float32(2e-3)}))
    assert set(beside) == {"velocities"}
    assert beside["velocities"]["predictor"]["mean"] == pytest.approx(2.0, rel=1e-3)
    assert beside["velocities"]["twin"]["mean"] == pytest.approx(1e3 * errors[1], rel=1e-4)
    with pytest.raises(DataError, match="no recording has 508 ticks"):
        look_ahead(twin, [replace(part, inputs=part.inputs[:50], targets=part.targets[:50])], 7, first=500)


def _scores(velocity, *strokes):
    return sample_free_run_scores(sample_errors(velocity, *strokes))


def test_a_twin_that_a_floor_beats_is_told_by_how_much():
    beaten = twin_beaten_by(
        {"twin": _scores(2.0, 1.0, 4.0), "static": _scores(2.0, 1.0, 0.5), "arx": _scores(1.9, 1, 4)}
    )
    assert beaten is not None
    assert beaten.label == "static"
    assert beaten.less == pytest.approx(0.5)  # a cube root of 1 * 1 * 8
    assert beaten.outputs == ("v",)
    assert "static has 50 % less error than the twin (on v): do not use this twin; take that floor" in beaten.sentence()


def test_a_twin_ahead_of_its_floors_is_not_beaten():
    assert twin_beaten_by({"twin": _scores(1.0, 1.0), "static": _scores(2.0, 1.0), "arx": _scores(0.0, 0.0)}) is None
    assert twin_beaten_by({"twin": _scores(1.0, 1.0)}) is None
