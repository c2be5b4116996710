"""What every loss, term, augmentation, average and output must do, whichever are registered."""

import copy
import itertools

import numpy as np
import pytest
import torch

from edp.data.augment import AUGMENTATIONS, Jitter, TimeWarp, WindowShift, input_deviation
from edp.data.chunks import ChunkSpec
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.losses import LOSSES, TERMS, AdaptiveWeights
from edp.networks.outputs import OUTPUTS, Laplace, Normal, Quantiles
from edp.networks.predictor import ModelSpec
from edp.networks.stream import Stream
from edp.testing.losses import (
    TASK,
    check_least_value,
    check_masked_ticks,
    check_objective,
    check_order_of_streams,
    loss_batch,
    loss_network,
)
from edp.training.averages import AVERAGES
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec, check_training

PAIRS = [(loss, output) for loss in LOSSES for output in LOSSES[loss].outputs]
STATED = [output for output in OUTPUTS if OUTPUTS[output]().coverages]


@pytest.mark.parametrize(("loss", "output"), PAIRS)
def test_the_objective_is_finite_and_its_gradient_reaches_every_parameter(loss, output):
    check_objective(loss, output)


@pytest.mark.parametrize(("loss", "output"), PAIRS)
def test_the_order_of_the_streams_does_not_matter(loss, output):
    check_order_of_streams(loss, output)


@pytest.mark.parametrize(("loss", "output"), PAIRS)
def test_ticks_that_do_not_count_do_not_matter(loss, output):
    check_masked_ticks(loss, output)


@pytest.mark.parametrize(("loss", "output"), PAIRS)
def test_a_loss_is_least_at_a_perfect_prediction(loss, output):
    check_least_value(loss, output)


@pytest.mark.parametrize("name", list(TERMS))
def test_a_term_is_zero_at_a_perfect_prediction_of_a_steady_change(name):
    net = loss_network("point")
    x, _, valid = loss_batch()
    steady = torch.arange(12.0, dtype=torch.float64).reshape(1, 12, 1, 1).expand(4, 12, 2, 2)
    with torch.no_grad():
        answer, features, _ = net.run(x, net.initial_state(4, x))
        course = Objective(TrainingSpec(), net.code)._course(
            steady - net.code.level(features), steady - net.code.level(features), net.code.level(features), valid
        )
        assert TERMS[name]().evaluate(course).abs() < 1e-7
        off = Objective(TrainingSpec(), net.code)._course(answer.center, steady, net.code.level(features), valid)
        assert TERMS[name]().evaluate(off) > 1e-3


@pytest.mark.parametrize("mode", [TargetMode.DELTA, TargetMode.ABSOLUTE])
def test_smoothness_sees_predicted_values_not_changes(mode):
    task = Task(TASK.features, TASK.targets, TASK.horizons, mode, 100.0)
    net = loss_network("point", task=task)
    x, _, _ = loss_batch()
    with torch.no_grad():
        answer, features, _ = net.run(x, net.initial_state(4, x))
        physical, _ = net.predict(x, net.initial_state(4, x))
    seen = (answer.center + net.code.level(features)) * net.code.width
    torch.testing.assert_close(seen, physical.expand_as(seen), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", list(TERMS))
def test_windows_must_be_drawn_in_runs_that_a_term_can_compare(name):
    term = TERMS[name]()
    windows = {"regime": "window", "length": 8, "batch": 12}
    TrainingSpec(terms=(term,), chunks=ChunkSpec(**windows, consecutive=term.span))
    if term.span > 1:
        with pytest.raises(ConfigError, match=rf"'{name}' compares {term.span}.*set chunks.consecutive = {term.span}"):
            TrainingSpec(terms=(term,), chunks=ChunkSpec(**windows))
        with pytest.raises(ConfigError, match=f"chunks have 1 ticks; {term.span} or more must hold"):
            TrainingSpec(terms=(term,), chunks=ChunkSpec(length=1))
    with pytest.raises(ConfigError, match="each at most once"):
        TrainingSpec(terms=(term, term))


@pytest.mark.parametrize("loss", list(LOSSES))
@pytest.mark.parametrize("output", list(OUTPUTS))
def test_a_loss_and_an_output_that_do_not_fit_are_refused_with_the_reason(loss, output):
    model, spec = ModelSpec(output=OUTPUTS[output]()), TrainingSpec(loss=LOSSES[loss]())
    if (loss, output) in PAIRS:
        check_training(TASK, model, spec)
    else:
        with pytest.raises(
            ConfigError, match=f"the loss '{loss}' trains the output .*, but model.output is '{output}'"
        ):
            check_training(TASK, model, spec)


def test_every_output_has_a_loss():
    assert {output for _, output in PAIRS} == set(OUTPUTS)


def test_weights_with_nothing_to_weigh_are_refused():
    alone = Task(TASK.features, ("a",), (4,), TargetMode.DELTA, 100.0)
    spec = TrainingSpec(horizon_decay=0.9, adaptive=AdaptiveWeights(blend=0.3))
    with pytest.raises(ConfigError, match=r"horizon_decay = 0.9 .* has one \(4\).*blend = 0.3 .* one target \('a'\)"):
        check_training(alone, ModelSpec(), spec)
    check_training(TASK, ModelSpec(), spec)


@pytest.mark.parametrize("output", list(OUTPUTS))
def test_every_output_predicts_in_the_same_shape_and_as_a_stream(output):
    net = loss_network(output).eval()
    x, _, _ = loss_batch(streams=1)
    with torch.no_grad():
        whole, _ = net.predict(x, net.initial_state(1, x))
        first, state = net.predict(x[:, :5], net.initial_state(1, x))
        second, _ = net.predict(x[:, 5:], state)
    assert whole.shape == (1, 12, 2, 2)
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole, rtol=0, atol=1e-12)
    rows = net.costs()
    assert sum(row.parameters for row in rows) == sum(parameter.numel() for parameter in net.parameters())


@pytest.mark.parametrize("output", STATED)
def test_intervals_lie_around_the_prediction_and_in_one_another(output):
    net = loss_network(output).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(2.0 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(2)))
    x, _, _ = loss_batch()
    with torch.no_grad():
        center, _ = net.predict(x, net.initial_state(4, x))
        bounds, _ = net.intervals(x, net.initial_state(4, x))
    assert bounds.shape == (4, 12, len(net.output.coverages), 2, 2, 2)
    assert list(net.output.coverages) == sorted(net.output.coverages, reverse=True)
    order = [*(bounds[:, :, i, 0] for i in range(bounds.shape[2])), center]
    order += [bounds[:, :, i, 1] for i in reversed(range(bounds.shape[2]))]
    assert all((low < high).all() for low, high in itertools.pairwise(order))


@pytest.mark.parametrize("output", STATED)
def test_a_stream_gives_the_same_intervals_tick_by_tick(output):
    net = loss_network(output).eval()
    x, _, _ = loss_batch(streams=1)
    with torch.no_grad():
        bounds, _ = net.intervals(x, net.initial_state(1, x))
    stream = Stream(net)
    for row in x[0]:
        tick = stream.step(row)
    np.testing.assert_allclose(
        np.stack(tick.interval(net.output.coverages[-1])), bounds[0, -1, -1].float().numpy(), rtol=1e-5, atol=1e-6
    )
    with pytest.raises(ConfigError, match=r"no interval of coverage 0.123; this network has 0.9"):
        tick.interval(0.123)


def test_a_point_has_no_intervals():
    net = loss_network("point").eval()
    with pytest.raises(ConfigError, match="this network has none: its output is a point"):
        Stream(net).step(np.zeros(len(net.task.inputs))).interval(0.9)


@pytest.mark.parametrize("output", STATED)
def test_calibrated_intervals_hold_their_share_of_what_they_were_calibrated_on(output):
    net = loss_network(output).eval()
    x, _, _ = loss_batch(streams=1, ticks=4001)
    with torch.no_grad():
        answer, _, _ = net.run(x, net.initial_state(1, x))
        target = (
            answer.center + 3.0 * torch.from_numpy(np.random.default_rng(4).standard_t(3, answer.center.shape)) + 0.5
        )
        net.output.calibrate(answer, target)
        for which, coverage in enumerate(net.output.coverages):
            lower, upper = net.output.interval(answer, which)
            held = ((lower <= target) & (target <= upper)).double().mean(dim=(0, 1))
            torch.testing.assert_close(held, torch.full_like(held, coverage), rtol=0, atol=1e-3)


def test_laws_reach_as_far_as_their_quantiles():
    sample = np.random.default_rng(5)
    for spec, drawn in (
        (Normal(coverages=(0.9, 0.5)), sample.normal(size=200_000)),
        (Laplace(coverages=(0.9, 0.5)), sample.laplace(scale=np.sqrt(0.5), size=200_000)),
    ):
        layer = spec.build(1, 1)
        answer = layer.answer(torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1, 1))  # log variance 0
        for which, coverage in enumerate(spec.coverages):
            lower, upper = (float(bound) for bound in layer.interval(answer, which))
            assert np.mean((lower <= drawn) & (drawn <= upper)) == pytest.approx(coverage, abs=0.005)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quantiles(levels=(0.1, 0.9)), r"levels = \[0.1, 0.9\].*must hold"),
        (lambda: Quantiles(levels=(0.1, 0.5, 0.8)), "symmetric about 0.5"),
        (lambda: Quantiles(levels=(0.9, 0.5, 0.1)), "increasing"),
        (lambda: Quantiles(levels=(0.0, 0.5, 1.0)), r"levels = \[0.0, 0.5, 1.0\]; 0 < levels < 1 must hold"),
        (lambda: Normal(coverages=()), "coverages has 0 entries; 1 to 99 must hold"),
        (lambda: Laplace(coverages=(0.5, 0.9)), "decreasing"),
        (lambda: Normal(coverages=(1.0,)), r"coverages = \[1.0\]; 0 < coverages < 1 must hold"),
        (lambda: Jitter(std=0.0), r"std = 0\.0; 0 < std <= 1 must hold"),
        (lambda: WindowShift(max_shift=0), "window_shift: max_shift = 0; integers, 1 <= max_shift"),
        (lambda: TimeWarp(strength=0.6), r"strength = 0\.6; .* must hold"),
        (lambda: AVERAGES["ema"](decay=1.0), r"decay = 1\.0; .* must hold"),
        (lambda: AVERAGES["swa"](fraction=0.0), r"fraction = 0\.0.*must hold"),
        (lambda: AVERAGES["swa"](lr_ratio=1.5), r"lr_ratio = 1\.5.*must hold"),
        (lambda: ChunkSpec(regime="window", batch=8, consecutive=3), "consecutive = 3, batch = 8; .* must hold"),
        (lambda: ChunkSpec(batch=9, consecutive=3), "consecutive = 3 with regime = 'chunk'.*1 must hold"),
    ],
)
def test_options_out_of_range_are_refused_with_the_value(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def stretch(samples=400):
    rng = np.random.default_rng(8)
    inputs = np.cumsum(rng.normal(size=(samples, 3)), axis=0).astype(np.float32)
    inputs[:, 2] = 4.0
    return Series("s", inputs, inputs[:, :2].copy())


@pytest.mark.parametrize("name", list(AUGMENTATIONS))
def test_an_augmentation_is_a_seeded_change_of_the_same_shape(name):
    part, spec = stretch(), AUGMENTATIONS[name]()
    before = copy.deepcopy(part)
    deviation = input_deviation([part])
    first, again, other = (spec.apply(part, deviation, np.random.default_rng(seed)) for seed in (1, 1, 2))
    for made in (first, other):
        assert made.inputs.shape == part.inputs.shape
        assert made.targets.shape == part.targets.shape
        assert made.inputs.dtype == made.targets.dtype == np.float32
        assert np.isfinite(made.inputs).all()
        np.testing.assert_array_equal(made.inputs[:, 2], part.inputs[:, 2])  # what stands still goes on to
    np.testing.assert_array_equal(first.inputs, again.inputs)
    np.testing.assert_array_equal(first.targets, again.targets)
    assert not np.array_equal(first.inputs, other.inputs)
    np.testing.assert_array_equal(part.inputs, before.inputs)
    np.testing.assert_array_equal(part.targets, before.targets)
    for samples in (1, 2, 3):
        short = stretch(samples)
        assert spec.apply(short, deviation, np.random.default_rng(0)).samples == samples


def test_jitter_has_the_size_asked_for():
    part, deviation = stretch(20_000), np.array([2.0, 0.5, 0.0], np.float32)
    made = Jitter(std=0.1).apply(part, deviation, np.random.default_rng(0))
    np.testing.assert_allclose((made.inputs - part.inputs).std(axis=0), 0.1 * deviation, rtol=0.03)
    assert made.targets is part.targets


def test_a_shift_moves_inputs_against_targets_within_its_bound():
    part, found = stretch(), set()
    for seed in range(60):
        made = WindowShift(max_shift=2).apply(part, None, np.random.default_rng(seed))
        (shift,) = [
            s for s in range(-5, 6) if np.array_equal(made.inputs[10:-10], part.inputs[10 + s : -10 + s or None])
        ]
        found.add(shift)
        np.testing.assert_array_equal(made.targets, part.targets)
    assert found == {-2, -1, 0, 1, 2}


def test_a_warp_keeps_the_ends_the_order_and_the_speed_within_its_bound():
    samples = 1000
    clock = np.arange(samples, dtype=np.float32)
    part = Series("clock", clock[:, None].copy(), -clock[:, None])
    moved = 0.0
    for seed in range(20):
        made = TimeWarp(strength=0.2).apply(part, None, np.random.default_rng(seed))
        time = made.inputs[:, 0]
        np.testing.assert_allclose(time[[0, -1]], [0, samples - 1], atol=1e-3)
        np.testing.assert_array_equal(made.targets[:, 0], -time)
        assert 0.6 < np.diff(time).min() < np.diff(time).max() < 1.45
        moved = max(moved, np.abs(time - clock).max())
    assert moved > 5


@pytest.mark.parametrize("name", list(AVERAGES))
def test_an_average_is_one_of_the_weights_that_were(name):
    spec, updates = AVERAGES[name](), 50
    weights = np.random.default_rng(0).normal(size=updates)
    average = 5.0
    for update, weight in enumerate(weights, start=1):
        step = spec.step(update, updates)
        assert 0 < step <= 1
        average += step * (weight - average)
        assert 0 <= spec.rate_factor(0.5, update, updates) <= 1
    if name == "swa":
        assert average == pytest.approx(weights[-10:].mean())
        assert [spec.rate_factor(0.5, update, updates) for update in (40, 41)] == [0.5, 0.3]
    elif name == "none":
        assert average == pytest.approx(weights[-1])
