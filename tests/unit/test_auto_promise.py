"""What the preset auto promises: errors, intervals, skill beside a simple model, and what became of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from edp.data.features import FeatureSet
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import StorageError
from edp.evaluation.guard import beaten_by
from edp.evaluation.scores_file import DataSituation, ModelScores, ScoredTarget, ScoredTask, ScoresFile
from edp.evaluation.situation import situation_of
from edp.report.run.choice import note_test_result, promise_line, read_choice
from edp.report.run.outputs import minutes_of, situation_line
from edp.signals import Channel, Kind
from edp.workflows.auto.promise import Promise


def promise(seed=0, blocks=60, outputs=2, spread=0.2):
    rng = np.random.default_rng(seed)
    squared = np.exp(spread * rng.normal(size=(blocks, outputs)))
    return Promise(squared, rng.integers(90, 110, blocks).astype(float))


def test_an_interval_surrounds_the_error_and_is_wider_for_a_short_test():
    one = promise()
    long, short = one.interval(6000), one.interval(300)
    for bounds in (long, short):
        assert (bounds["low"] < one.error()).all()
        assert (one.error() < bounds["high"]).all()
    assert (short["high"] - short["low"] > 1.5 * (long["high"] - long["low"])).all()
    assert all((one.interval(300)[side] == short[side]).all() for side in short)


def test_it_holds_nine_of_ten_tests_of_the_same_kind():
    inside = []
    for seed in range(100):
        one, test = promise(seed, outputs=1), promise(1000 + seed, blocks=20, outputs=1)
        bounds = one.interval(int(test.rows.sum()))
        inside.append(bounds["low"][0] <= test.error()[0] <= bounds["high"][0])
    assert 0.8 <= np.mean(inside) <= 0.98


def test_skill_is_sure_where_both_models_err_on_the_same_blocks():
    hard = np.exp(np.random.default_rng(1).normal(size=(60, 1)))
    rows = np.full(60, 100.0)
    ours, other = Promise(0.25 * hard, rows), Promise(np.concatenate([hard, hard]), np.full(120, 100.0))
    skill = ours.relative_to(other)
    assert skill.error() == pytest.approx([0.5])
    bounds = skill.interval(600)
    assert bounds["low"] == pytest.approx([0.5])
    assert bounds["high"] == pytest.approx([0.5])
    assert ours.interval(600)["high"][0] > 1.2 * ours.error()[0]


def test_errors_of_zero_are_no_numbers_that_are_none():
    nothing = Promise(np.zeros((4, 1)), np.full(4, 10.0))
    assert np.isfinite(nothing.interval(5)["high"]).all()
    assert np.isfinite(nothing.relative_to(nothing).interval(5)["high"]).all()


def errors(value):
    return {"1": {"v": value}}


def content(test=1.1, floor=2.0):
    skill = {"against": "linear", "promise": errors(0.5), "interval": {"low": errors(0.4), "high": errors(0.6)}}
    return {
        "key": "k", "sentence": "s", "minutes": 1.0, "chosen": "committee", "excess": {"committee": 0.0},
        "candidates": {"committee": {"label": "c", "parameters": 3, "seconds": 1.0, "promise": errors(1.0)}},
        "persistence": errors(3.0), "interval": {"low": errors(0.8), "high": errors(1.2)}, "skill": skill,
        "notes": [],
    }  # fmt: skip


def scores(value, **models):
    network = ModelScores(label="m", overall={"1": {"v": {"rmse": value}, "mean": {"rmse": value}}})
    return ScoresFile(
        task=ScoredTask(horizons=(1,)), targets=(ScoredTarget(name="v"),), models={"network": network, **models}
    )


def test_what_became_of_a_promise_is_said(tmp_path):
    (tmp_path / "auto.json").write_text(json.dumps(content()))
    assert promise_line(read_choice(tmp_path)) == ""
    note_test_result(tmp_path, scores(1.1), scores(2.0).models["network"])
    assert promise_line(read_choice(tmp_path)) == (
        "The promised error held on 1 of 1 pair of output and horizon (within its 90 % interval); relative to the "
        "linear model's it was promised as 0.50 and is 0.55."
    )
    note_test_result(tmp_path, scores(1.3), None)
    line = promise_line(read_choice(tmp_path))
    assert line.startswith("The promised error held on 0 of 1")


def test_who_gave_the_preset_auto_too_little_time_is_told_to_give_it_more(tmp_path):
    (tmp_path / "auto.json").write_text(json.dumps(content()))
    judged = scores(1.0, trees=ModelScores(label="Trees", overall={"1": {"v": {"rmse": 0.5}}}))
    assert "more than 1 minute (" in beaten_by(judged, minutes_of(tmp_path)).sentence()
    assert "train with the preset auto" in beaten_by(judged, minutes_of(tmp_path / "none")).sentence()


@pytest.mark.parametrize(
    "change",
    [
        {"interval": {"low": errors(1.0)}},
        {"skill": {"against": "x"}},
        {"skill": []},
        {"notes": 3},
        {"notes": [3]},
        {"interval": {"low": {"1": {"v": "a"}}, "high": errors(1.0)}},
    ],
)
def test_damaged_promises_are_refused(tmp_path, change):
    (tmp_path / "auto.json").write_text(json.dumps(content() | change))
    with pytest.raises(StorageError, match=r"auto\.json"):
        read_choice(tmp_path)


def test_runs_of_earlier_versions_have_no_interval(tmp_path):
    old = {key: value for key, value in content().items() if key not in ("interval", "skill", "notes")}
    (tmp_path / "auto.json").write_text(json.dumps(old))
    note_test_result(tmp_path, scores(1.1))
    assert promise_line(read_choice(tmp_path)) == ""


def prepared(train, test, targets=("v",)):
    channels = (Channel("u", Kind.GENERIC), Channel("v", Kind.GENERIC))
    features = FeatureSet("two", ("u", "v"))
    task = Task(features, targets, (1, 5), TargetMode.DELTA, 50.0)

    def series(values):
        return Series("s", np.float32(values), np.float32(values[:, 1:]))

    kinds = (Kind.GENERIC,)
    return Prepared(task, [series(train)], [series(train)], [series(test)], channels, kinds * 2, kinds, ("v",), "d")


def walk(seed, size=1.0, samples=2000):
    rng = np.random.default_rng(seed)
    u = np.sin(np.arange(samples) / 20 + rng.uniform(0, 6))
    return np.stack([u, size * np.sin(np.arange(samples) / 30 + rng.uniform(0, 6))], axis=1)


def test_a_test_like_the_training_is_no_other_situation():
    found = situation_of(prepared(walk(0), walk(1)))
    assert found == DataSituation(outside=(), changes=())
    assert situation_line(replace(scores(1.0), situation=found)) == situation_line(scores(1.0)) == ""


def test_values_outside_of_the_range_and_changes_of_another_size_are_said():
    found = situation_of(prepared(walk(0), walk(1, size=3.0)))
    assert [row.channel for row in found.outside] == ["v"]
    assert found.outside[0].share == pytest.approx(1 - 2 * np.arcsin(1 / 3) / np.pi, abs=0.05)
    assert {row.horizon for row in found.changes} == {1, 5}
    assert all(row.ratio == pytest.approx(3.0, rel=0.05) for row in found.changes)
    line = situation_line(replace(scores(1.0), situation=found))
    assert "v is outside of its range in training in" in line
    assert "3 times as large as in training" in line


def test_a_test_at_rest_is_said_and_one_that_never_moves_is_no_error():
    rest = walk(1)
    rest[:, 1] = 0.01 * np.random.default_rng(0).normal(size=len(rest))
    assert "times as large" in situation_line(replace(scores(1.0), situation=situation_of(prepared(walk(0), rest))))
    rest[:, 1] = 0.0
    assert situation_of(prepared(walk(0), rest)).changes == ()
    assert situation_of(prepared(rest, rest)).outside == ()


def test_a_bundle_alone_has_no_training_to_differ_from():
    alone = replace(prepared(walk(0), walk(1)), train=[], validation=[])
    assert situation_of(alone) == DataSituation(outside=(), changes=())


def test_a_training_no_longer_than_the_horizon_has_no_changes_to_compare():
    found = situation_of(prepared(walk(0, samples=4), walk(1)))
    assert {row.horizon for row in found.changes} <= {1, 5}


def test_rare_pulses_are_said():
    pulses = walk(1)
    pulses[::100, 1] += 0.1
    line = situation_line(replace(scores(1.0), situation=situation_of(prepared(walk(0), pulses))))
    assert "of the changes of v in" in line


def test_a_shorter_promise_uses_the_blocks_that_both_left_out():
    one = promise(blocks=60, outputs=1)
    few = replace(one.last(10))
    assert one.relative_to(few).error() == pytest.approx([1.0])
