"""Importance of channels to a trained predictor: exact on laws that are known."""

from dataclasses import replace

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.data.features import FeatureSet
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, DataError
from edp.evaluation.channel_importance import ChannelImportanceSpec, _donors, measure_channel_importance
from edp.evaluation.conditional import OthersModel, collinear
from edp.networks.blocks import LinearBypass
from edp.signals import Channel, Kind
from edp.training import fit

NAMES = ("speed", "lever", "twice", "noise", "second")
SPEC = ChannelImportanceSpec(repeats=2, groups=(("lever", "twice"),), skip=20)


def drive(seed, samples=900):
    """The speed follows lever and second lever; `twice` is a law of the lever, and noise is noise."""
    rng = np.random.default_rng(seed)
    lever, second = (np.repeat(rng.normal(size=samples // 20 + 1), 20)[:samples] for _ in range(2))
    speed = np.zeros(samples)
    for t in range(3, samples):
        speed[t] = 0.9 * speed[t - 1] + 0.03 * lever[t - 3] + 0.01 * second[t - 3]
    inputs = np.column_stack([speed, lever, 2 * lever + 1, rng.normal(size=samples), second]).astype(np.float32)
    return Series(f"drive {seed}", inputs, inputs[:, :1].copy())


@pytest.fixture(scope="module")
def data():
    task = Task(FeatureSet("law", NAMES), ("speed",), (3,), TargetMode.DELTA, 100.0)
    kinds = (Kind.VELOCITY, *[Kind.GENERIC] * 4)
    return Prepared(
        task, [drive(1), drive(2)], [drive(3)], [drive(4), drive(5), drive(6, 700)],
        tuple(Channel(name, kind) for name, kind in zip(NAMES, kinds, strict=True)),
        kinds, (Kind.VELOCITY,), ("",), "0" * 32,
    )  # fmt: skip


@pytest.fixture(scope="module")
def predictor(data, tiny_model, tiny_training):
    model = replace(tiny_model, blocks=(LinearBypass(taps=5),))
    return fit(data, model, replace(tiny_training, epochs=2, updates=20)).predictor


@pytest.fixture(scope="module")
def importances(predictor, data):
    seen = NotedProgress()
    found = measure_channel_importance(predictor, data, SPEC, seen)
    assert seen.stages == [("channel", 6)]
    assert seen.notes == [", ".join(row.members) for row in found.rows[::2]]
    assert seen.steps == [1, 2, 3, 4, 5, 6]
    return found


def test_importances_follow_the_law(importances):
    rows = {row.members: row for row in importances.rows if row.target == "mean"}
    base = importances.error["3"]["mean"]
    lever, twice, both = rows[("lever",)], rows[("twice",)], rows[("lever", "twice")]
    # A law gives the one from the other: alone they have nothing of their own, together nearly all.
    assert lever.explained > 0.999
    assert twice.explained > 0.999
    assert both.explained < 0.9
    assert max(lever.renewed.mean, twice.renewed.mean) < 0.05 * both.renewed.mean
    assert both.renewed.low > base
    assert both.exchanged.mean > rows[("second",)].exchanged.mean > 0
    assert rows[("second",)].renewed.low > 0
    assert abs(rows[("noise",)].exchanged.mean) < 0.05 * both.exchanged.mean
    assert [row.members for row in importances.ranked(3)[:2]] == [("speed",), ("lever", "twice")]
    assert importances.units == {"mean": "mm/s", "speed": "mm/s"}
    for row in importances.rows:
        assert row.exchanged.low <= row.exchanged.mean <= row.exchanged.high


def test_the_same_seed_gives_the_same_importances(importances, predictor, data):
    assert measure_channel_importance(predictor, data, SPEC) == importances
    assert measure_channel_importance(predictor, data, replace(SPEC, seed=1)) != importances


def test_one_recording_is_exchanged_with_itself_far_off(predictor, data):
    found = measure_channel_importance(
        predictor, replace(data, test=data.test[:1]), ChannelImportanceSpec(repeats=1, skip=20)
    )
    rows = {row.members: row for row in found.rows if row.target == "mean"}
    assert rows[("second",)].renewed.mean > 0
    rng = np.random.default_rng(0)
    assert all(225 <= _donors(data.test[:1], rng)[0].start <= 675 for _ in range(50))
    for _ in range(50):
        assert all(donor.recording != i for i, donor in enumerate(_donors(data.test, rng)))


def test_hinges_tell_a_threshold():
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, (4000, 3)).astype(np.float32)
    values[:, 1] = np.maximum(values[:, 0] - 0.5, 0) * 3
    model = OthersModel.fit([values[:3000], values[3000:]], (0, 1), 10_000)
    (told, _), shares = model.expect([[1], [2]], [values])
    assert shares[0] > 0.99
    assert shares[1] < 0.05
    assert np.corrcoef(told[0][:, 0], values[:, 1])[0, 1] > 0.995


def test_still_channels_and_lone_channels():
    values = np.column_stack([np.full(500, 7.0), np.arange(500)]).astype(np.float32)
    model = OthersModel.fit([values], (0, 2), 500)
    (still, moving), shares = model.expect([[0], [1]], [values])
    assert np.allclose(still[0], 7.0)
    assert np.allclose(moving[0], values[:, 1].mean())
    assert shares == [0.0, 0.0]
    (all_of_them,), _ = model.expect([[0, 1]], [values])
    assert np.allclose(all_of_them[0], values.mean(axis=0))


def test_mistakes_are_told(predictor, data):
    with pytest.raises(ConfigError, match=r"names 'levr', which is no input.*lever"):
        measure_channel_importance(predictor, data, ChannelImportanceSpec(groups=(("levr", "noise"),)))
    with pytest.raises(DataError, match="longest has 900 samples, the first 2000 are start-up"):
        measure_channel_importance(predictor, data, ChannelImportanceSpec(skip=2000))
    with pytest.raises(ConfigError, match="repeats = 0"):
        ChannelImportanceSpec(repeats=0)
    with pytest.raises(ConfigError, match=r"lags = \[0, -1\]; integers, 0 <= lags"):
        ChannelImportanceSpec(lags=(0, -1))


def test_collinear_channels_form_groups():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 2000))
    values = np.column_stack([a, b, np.exp(a), np.zeros(2000), -b + 0.1 * a]).astype(np.float32)
    assert collinear([values[:900], values[900:]]) == [[0, 2], [1, 4]]
    assert collinear([values[:, :1]]) == []
    assert collinear([values], least=0.999) == [[0, 2]]
