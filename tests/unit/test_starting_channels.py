"""Channels of the start: a free run that begins from a measured state."""

import dataclasses

import numpy as np
import pytest
import torch

from edp.data.features import STARTING, Derived, FeatureSet
from edp.data.prepared import Prepared
from edp.data.scaling import feature_matrix
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.evaluation.judge import JudgeSpec, baseline_task, judge
from edp.networks.plain import task_from_dict, task_to_dict
from edp.networks.predictor import build_model
from edp.networks.stream import Stream
from edp.signals import Channel, Kind
from edp.training.fit import fit
from edp.training.optimizers import AdamW

pytestmark = pytest.mark.long

TICKS = 4
FEATURES = FeatureSet("free", ("lever",), (Derived("dlever", "lever"),), init_channels=("boom",), init_samples=TICKS)
TASK = Task(FEATURES, ("boom",), (0,), TargetMode.ABSOLUTE, 100.0)


def integrator(seed, samples=150):
    """A level that leaks slowly: where it started counts for a second."""
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.normal(size=samples // 20 + 1), 20)[:samples]
    level = np.empty(samples)
    level[0] = 3.0 * rng.normal()
    for t in range(1, samples):
        level[t] = 0.98 * level[t - 1] + 0.02 * lever[t - 1]
    return Series(f"run {seed}", np.column_stack([lever, level]).astype(np.float32), level[:, None].astype(np.float32))


@pytest.fixture(scope="module")
def free():
    return Prepared(
        task=TASK,
        train=[integrator(seed) for seed in range(8)],
        validation=[integrator(seed) for seed in (20, 21)],
        test=[integrator(seed) for seed in (30, 31, 32)],
        inputs=(Channel("lever", Kind.GENERIC), Channel("boom", Kind.VELOCITY)),
        feature_kinds=(Kind.GENERIC, Kind.GENERIC, Kind.VELOCITY, Kind.GENERIC),
        target_kinds=(Kind.VELOCITY,),
        descriptions=("boom",),
        digest="1" * 32,
    )


@pytest.fixture(scope="module")
def predictor(free, tiny_model):
    return build_model(TASK, tiny_model, free.scaler(), 0).double().eval()


def run(predictor, x):
    with torch.no_grad():
        return predictor.predict(x, predictor.initial_state(len(x), x))[0]


def test_names_and_order():
    assert FEATURES.inputs == ("lever", "boom")
    assert FEATURES.features == ("lever", "dlever", "boom", STARTING)
    assert FEATURES.lasting == ("lever", "dlever")
    assert TASK.present == (None,)  # the target's present value is not known at every tick


def test_sources_and_lengths_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="not an input at every tick"):
        FeatureSet("f", ("a",), (Derived("db", "b"),), init_channels=("b",))
    with pytest.raises(ConfigError, match="names a twice"):
        FeatureSet("f", ("a",), init_channels=("a",))
    with pytest.raises(ConfigError, match="init_samples = 0; integers, 1 <= init_samples"):
        FeatureSet("f", ("a",), init_channels=("b",), init_samples=0)
    with pytest.raises(ConfigError, match="not a feature"):
        Task(FEATURES, ("boom",), (1,), TargetMode.DELTA, 100.0)


def test_the_start_is_read_for_so_many_ticks_and_nothing_after_them_counts(predictor):
    x = torch.randn(2, 20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    later, earlier = x.clone(), x.clone()
    later[:, TICKS:, 1] = torch.nan
    earlier[:, TICKS - 1, 1] += 1.0
    assert torch.equal(run(predictor, later), run(predictor, x))
    changed = run(predictor, earlier)
    assert torch.equal(changed[:, : TICKS - 1], run(predictor, x)[:, : TICKS - 1])
    assert not torch.allclose(changed[:, TICKS - 1 :], run(predictor, x)[:, TICKS - 1 :])


@pytest.mark.parametrize("cut", [1, TICKS - 1, TICKS, TICKS + 1])
def test_any_split_gives_the_same_numbers(cut, predictor):
    x = torch.randn(1, 12, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with torch.no_grad():
        first, state = predictor.predict(x[:, :cut], predictor.initial_state(1, x))
        second, _ = predictor.predict(x[:, cut:], state)
    torch.testing.assert_close(torch.cat([first, second], 1), run(predictor, x), rtol=0, atol=1e-12)
    stream = Stream(predictor)
    steps = np.stack([stream.step(row).prediction for row in x[0]])
    np.testing.assert_allclose(steps, run(predictor, x)[0].float().numpy(), rtol=1e-6, atol=1e-7)


def test_features_are_scaled_as_in_the_first_ticks(free, predictor):
    matrix = feature_matrix(TASK, free.train[0])
    x = torch.from_numpy(free.train[0].inputs[None]).double()
    features, _ = predictor.front(x, predictor.front.initial_state(1, x))
    np.testing.assert_allclose(features[0, :TICKS].numpy(), matrix[:TICKS], rtol=1e-6)
    scaled = predictor.front.scale(features)[0, :, 2:]
    assert torch.all(scaled[TICKS:] == torch.tensor([0.0, -1.0], dtype=torch.float64))
    assert torch.all(scaled[:TICKS, 1] == 0)
    assert STARTING not in free.scaler().constant


def test_a_task_survives_the_header_of_a_bundle():
    assert task_from_dict(task_to_dict(TASK)) == TASK
    plain = task_to_dict(TASK)
    del plain["features"]["init_channels"], plain["features"]["init_samples"]  # of a bundle from before
    assert task_from_dict(plain).features.init_channels == ()


def test_baselines_do_not_see_the_start_and_it_is_not_scored(free, predictor):
    spec = JudgeSpec(baselines=("persistence", "ridge_arx"), history=5, warmup_samples=0)
    assert baseline_task(free, spec).present == (None,)
    found = judge(predictor.float(), free, spec, "network").scores
    assert found.task.skip == TICKS
    changed = dataclasses.replace(free, test=[dataclasses.replace(s, inputs=s.inputs * [1, 0]) for s in free.test])
    again = judge(predictor.float(), changed, spec, "network").scores
    assert found.models["ridge_arx"].overall == again.models["ridge_arx"].overall


def test_a_network_learns_to_start_from_a_measured_state(free, tiny_model, tiny_training):
    chunks = dataclasses.replace(tiny_training.chunks, length=75, batch=8, burn_in=TICKS, reset_after_chunks=1)
    spec = dataclasses.replace(
        tiny_training, chunks=chunks, epochs=4, updates=100, patience=0, optimizer=AdamW(learning_rate=1e-2)
    )
    blind = dataclasses.replace(
        free, task=dataclasses.replace(TASK, features=FeatureSet("blind", ("lever",), FEATURES.derived))
    )
    blind = dataclasses.replace(
        blind,
        feature_kinds=free.feature_kinds[:2],
        inputs=free.inputs[:1],
        **{
            part: [dataclasses.replace(s, inputs=s.inputs[:, :1]) for s in getattr(free, part)]
            for part in ("train", "validation", "test")
        },
    )

    def error(data):
        fitted = fit(data, tiny_model, spec)
        scores = judge(fitted.predictor, data, JudgeSpec(baselines=(), warmup_samples=TICKS), "").scores
        return scores.models["network"].overall["0"]["mean"]["mae"]

    assert error(free) < 0.7 * error(blind)
