"""Errors by what the axes did: situations by hand, shares that add up, and targets that have none."""

from dataclasses import replace

import numpy as np
import pytest

from edp.data.features import FeatureSet
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.evaluation.by_situation import NEAR_STOP, SITUATIONS, Situations
from edp.evaluation.judge import score_predictions
from edp.evaluation.scores_file import ModelScores, ScoredTarget, ScoredTask, ScoresFile
from edp.report.run.tables import situation_table
from edp.settings.results import plain_value
from edp.signals import Channel, Kind

RATE, STILL = 10.0, 0.0
SPEEDS = np.array([0, 0, 0, 20, 100, 60, -60, -20, 0, 0, 20, 20, 20, 0], np.float32) / 1000
LEVERS = np.array([0, 0, 1, 1, 1, -1, -1, 0, 0, 0, 0.05, 1, 0, 0], np.float32)


def prepared(kinds=(Kind.VELOCITY,), channels=None, repeats=20, targets=("v",)) -> Prepared:
    """A velocity, the stroke that it makes and its lever, the same course again and again."""
    channels = channels or (
        Channel("v", Kind.VELOCITY), Channel("x", Kind.POSITION), Channel("u", Kind.RATIO)
    )  # fmt: skip
    speed, lever = np.tile(SPEEDS, repeats), np.tile(LEVERS, repeats)
    stroke = np.cumsum(speed) / RATE
    columns = {"v": speed, "x": stroke, "u": lever, "p": 1e5 * np.abs(speed) + 1e5}
    inputs = np.stack([columns[c.name] for c in channels], axis=1).astype(np.float32)
    truth = np.stack([columns[name] for name in targets], axis=1).astype(np.float32)
    series = Series("s", inputs, truth)
    task = Task(FeatureSet("f", tuple(c.name for c in channels)), targets, (1,), TargetMode.ABSOLUTE, RATE)
    every = tuple(c.kind for c in channels)
    return Prepared(task, [series], [series], [series], channels, every, tuple(kinds), ("",) * len(targets), "d")


def found_of(data: Prepared, ticks: int):
    ((target, found),) = Situations(data).find_masks(data.test[0], 1, ticks)
    assert target == 0
    return found


def test_situations_by_hand():
    """The course above, its fastest speed 0.1 m/s: at rest below 1 mm/s, fast above 50."""
    found = found_of(prepared(), len(SPEEDS) - 1)
    expected = {
        "rest": [0, 1, 8],
        "starting": [2, 9],
        "stopping": [7, 12],
        "reversing": [5],
        "fast": [4, 5, 6],
        # Commands up to 0.15 ask for nothing; at ticks 0, 1 and 8 the axis rests.
        "dead_band": [7, 9, 10, 12],
    }
    assert {name: np.flatnonzero(found[name]).tolist() for name in expected} == expected
    # The axis moves on with every repeat, so that the first and last ticks of the log are near the ends.
    assert found["end_stop"].any()
    every = np.logical_or.reduce([ticks for name, ticks in found.items() if name != "other"])
    assert np.array_equal(found["other"], ~every)


def test_near_an_end_is_told_by_the_range_of_all_series():
    data = prepared()
    column = data.inputs.index(Channel("x", Kind.POSITION))
    place = data.test[0].inputs[:-1, column]
    low, high = place.min(), data.test[0].inputs[:, column].max()
    near = NEAR_STOP * (high - low)
    expected = (place < low + near) | (place > high - near)
    assert np.array_equal(found_of(data, len(place))["end_stop"], expected)


def test_what_no_input_shows_is_not_told():
    """Without stroke and lever among the inputs both situations are missing, not empty."""
    found = found_of(prepared(channels=(Channel("v", Kind.VELOCITY),)), 10)
    assert set(SITUATIONS) - set(found) == {"dead_band", "end_stop"}


def test_a_position_of_another_kind_is_no_stroke():
    channels = (Channel("v", Kind.VELOCITY), Channel("x", Kind.ANGLE), Channel("u", Kind.RATIO))
    assert "end_stop" not in found_of(prepared(channels=channels), 10)


def test_targets_that_are_no_velocities_have_no_situations():
    channels = (Channel("p", Kind.PRESSURE),)
    data = prepared(kinds=(Kind.PRESSURE,), channels=channels, targets=("p",))
    assert Situations(data).axes == ()
    scores = score_predictions([np.repeat(data.test[0].targets[:, None], 1, axis=1)], data, 0)
    assert scores.by_situation == {}


def test_an_axis_that_never_moves_has_no_situations():
    data = prepared()
    still = Series("s", data.test[0].inputs, np.zeros_like(data.test[0].targets))
    assert Situations(Prepared(**{**vars(data), "test": [still]})).axes == ()


@pytest.fixture
def scores():
    """Held values one tick ahead: wrong by the change of the velocity, in mm/s."""
    data = prepared()
    return data, score_predictions([data.test[0].targets[:, None].copy()], data, 3)


def test_errors_and_shares(scores):
    """Errors are those of the ticks of a situation; situations that leave nothing out hold all of the error."""
    data, row = scores[0], plain_value(scores[1])
    found = found_of(data, data.test[0].samples - 1)
    size = 1e3 * np.abs(np.diff(data.test[0].targets[:, 0].astype(np.float64)))
    rows = {entry["situation"]: entry for entry in row["by_situation"]["1"]}
    for name, entry in rows.items():
        ticks = found[name].copy()
        ticks[:3] = False  # start-up is not scored
        assert entry["ticks"] == ticks.sum()
        assert entry["share"] == pytest.approx(ticks.sum() / (len(size) - 3))
        assert entry["mae"]["v"] == pytest.approx(size[ticks].mean(), rel=1e-5, abs=1e-9)
        assert entry["of_error"] == pytest.approx(size[ticks].sum() / size[3:].sum(), rel=1e-5, abs=1e-9)
    assert sum(entry["of_error"] for entry in rows.values()) >= 1.0
    assert rows["rest"]["mae"]["v"] == 0.0


def test_ticks_without_a_prediction_are_left_out():
    data = prepared()
    values = data.test[0].targets[:, None].copy()
    values[:40] = np.nan
    rows = plain_value(score_predictions([values], data, 3).by_situation["1"])
    shares = {row["situation"]: row["share"] for row in rows}
    assert all(np.isfinite(list(row["mae"].values())).all() for row in rows)
    assert max(shares.values()) <= 1.0


def test_table_shows_most_of_the_error_first_and_the_best_baseline(scores):
    data, held = scores
    better = score_predictions([1.0 * data.test[0].targets[:, None] * 0.99], data, 3)
    content = ScoresFile(
        task=ScoredTask(horizons=(1,)),
        targets=(ScoredTarget(name="v", unit="mm/s"),),
        models={"network": replace(better, label="network"), "persistence": replace(held, label="Persistence")},
    )
    sheet = situation_table(content, 1)
    assert [c.heading for c in sheet.columns] == ["Situation", "Of the time", "Of the error", "v", "Relative to"]
    shown = [float(text[2].split()[0]) for text in sheet.texts()]
    assert shown == sorted(shown, reverse=True)
    assert situation_table(replace(content, models={"network": ModelScores(label="n", overall={})}), 1) is None
