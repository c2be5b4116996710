import math

import numpy as np
import pytest
import torch

from edp.errors import ConfigError
from edp.networks.losses import (
    LOSSES,
    TERMS,
    AdaptiveWeights,
    Correlation,
    Course,
    Derivative,
    Drift,
    Focal,
    Heteroscedastic,
    Huber,
    MeanSquared,
    Penalty,
    Prediction,
    Quantile,
    Smoothness,
    compute_masked_loss,
    horizon_weights,
    output_weights,
)

ERRORS = torch.arange(-120, 121, dtype=torch.float64) / 20
SHAPE = (3, 11, 2, 4)  # stream, time, horizon, output


def point(center):
    return Prediction(center, center.new_zeros(*center.shape[:-1], 0, center.shape[-1]))


def draw(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def tensor(values):
    return torch.from_numpy(np.asarray(values))


@pytest.mark.parametrize("delta", [0.25, 1.0, 1.5, 4.0])
def test_huber_is_that_of_pytorch(delta):
    wanted = torch.nn.HuberLoss(reduction="none", delta=delta)(ERRORS, torch.zeros_like(ERRORS))
    torch.testing.assert_close(Huber(delta=delta).penalty(ERRORS), wanted, rtol=0, atol=1e-14)


def test_huber_has_the_gradient_of_pytorch():
    ours, theirs = ERRORS.clone().requires_grad_(), ERRORS.clone().requires_grad_()
    Huber(delta=1.5).penalty(ours).sum().backward()
    torch.nn.HuberLoss(reduction="sum", delta=1.5)(theirs, torch.zeros_like(ERRORS)).backward()
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=0, atol=1e-14)


def test_mse_is_the_square():
    torch.testing.assert_close(MeanSquared().penalty(ERRORS), ERRORS**2)


@pytest.mark.parametrize("name", [name for name in LOSSES if issubclass(LOSSES[name], Penalty)])
def test_every_penalty_is_zero_at_zero_even_and_rising(name):
    penalty = LOSSES[name]().penalty(ERRORS)
    assert penalty[120] == 0
    torch.testing.assert_close(penalty, penalty.flip(0))
    assert (penalty[120:].diff() > 0).all()


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_weights_are_eq_3_31_and_sum_to_the_outputs(power):
    sigma = torch.tensor([[0.1, 0.05, 0.4], [1.0, 2.0, 3.0]])
    weights = output_weights(sigma, power)
    torch.testing.assert_close(weights.sum(dim=-1), torch.full((2,), 3.0))
    ratio = weights[:, 0] / weights[:, 2]
    torch.testing.assert_close(ratio, (sigma[:, 2] / sigma[:, 0]) ** power)


def test_masked_loss_is_the_mean_over_valid_ticks():
    torch.manual_seed(0)
    prediction, target = torch.randn(2, 2, 5, 3, 2).double()
    valid = torch.tensor([[True, False, True, True, False], [False] * 5])
    weights = torch.tensor([[0.5, 1.5], [1.0, 1.0], [1.2, 0.8]]).double()
    found = compute_masked_loss(MeanSquared(), point(prediction), target, valid, weights)
    rows = [(prediction[0, t] - target[0, t]).square() * weights for t in (0, 2, 3)]
    torch.testing.assert_close(found, torch.stack(rows).mean())


def test_ticks_that_do_not_count_give_no_gradient():
    prediction = torch.zeros(1, 4, 1, 1, requires_grad=True)
    valid = torch.tensor([[False, True, False, True]])
    compute_masked_loss(Huber(), point(prediction), torch.ones(1, 4, 1, 1), valid, torch.ones(1)).backward()
    assert prediction.grad.flatten().tolist() == [0.0, -0.5, 0.0, -0.5]


def test_a_batch_without_valid_ticks_costs_nothing():
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    loss = compute_masked_loss(Huber(), point(torch.ones(2, 3, 1, 1)), torch.zeros(2, 3, 1, 1), nothing, torch.ones(1))
    assert loss == 0


@pytest.mark.parametrize(("gamma", "delta"), [(0.0, 1.5), (0.5, 1.0), (2.0, 1.5)])
def test_focal_weighs_huber_by_a_power_of_the_error(gamma, delta):
    e = ERRORS.numpy()
    size = np.abs(e)
    wanted = size**gamma * np.where(size <= delta, e**2 / 2, delta * (size - delta / 2))
    error = ERRORS.clone().requires_grad_()
    found = Focal(gamma=gamma, delta=delta).penalty(error)
    np.testing.assert_allclose(found.detach().numpy(), wanted, rtol=0, atol=1e-12)
    found.sum().backward()
    assert torch.isfinite(error.grad).all()


@pytest.mark.parametrize("law", ["normal", "laplace"])
@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_heteroscedastic_is_the_likelihood_weighted_by_a_power_of_the_variance(law, beta):
    center, target, s = draw(*SHAPE), draw(*SHAPE, seed=1), draw(*SHAPE, seed=2)
    answer = Prediction(tensor(center), tensor(s).unsqueeze(-2), law=law)
    found = Heteroscedastic(beta=beta).evaluate(answer, tensor(target)).numpy()
    e, sigma = center - target, np.exp(s / 2)
    if law == "normal":
        density = np.exp(-((e / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
        constant = np.log(2 * np.pi) / 2
    else:
        b = sigma / np.sqrt(2)
        density, constant = np.exp(-np.abs(e) / b) / (2 * b), np.log(2) / 2
    np.testing.assert_allclose(found, (-np.log(density) - constant) * sigma ** (2 * beta), rtol=1e-9, atol=1e-9)


def test_no_gradient_flows_through_the_weight_of_the_likelihood():
    s = torch.zeros(1, 1, 1, 1, 1, requires_grad=True)
    for beta in (0.0, 1.0):
        answer = Prediction(torch.full((1, 1, 1, 1), 2.0), s, law="normal")
        loss = Heteroscedastic(beta=beta).evaluate(answer, torch.zeros(1, 1, 1, 1)).sum()
        assert torch.autograd.grad(loss, s)[0].item() == pytest.approx(0.5 * (1 - 4))


def test_quantile_is_twice_the_pinball_loss_over_all_levels():
    center, target = draw(*SHAPE), draw(*SHAPE, seed=1)
    levels, offsets = (0.1, 0.3, 0.7, 0.9), np.array([-1.2, -0.4, 0.5, 1.1])
    spread = np.broadcast_to(offsets[:, None], (*SHAPE[:3], 4, SHAPE[3]))
    found = Quantile().evaluate(Prediction(tensor(center), tensor(spread.copy()), levels=levels), tensor(target))
    total = np.zeros(SHAPE)
    for level, offset in [(0.5, 0.0), *zip(levels, offsets, strict=True)]:
        u = target - (center + offset)
        total += np.where(u > 0, level * u, (level - 1) * u)
    np.testing.assert_allclose(found.numpy(), 2 * total / 5, rtol=0, atol=1e-12)


def test_the_pinball_loss_is_least_at_the_quantiles():
    sample = tensor(draw(20_000)).reshape(1, -1, 1, 1)
    still = torch.zeros_like(sample)

    def loss(distance):
        spread = torch.tensor([-distance, distance]).double().reshape(1, 1, 1, 2, 1).expand(1, sample.shape[1], 1, 2, 1)
        return Quantile().evaluate(Prediction(still, spread, levels=(0.05, 0.95)), sample).mean().item()

    tried = np.linspace(1.0, 2.4, 57)
    assert tried[np.argmin([loss(distance) for distance in tried])] == pytest.approx(1.645, abs=0.06)


def course(seed=0, level=True):
    rng = np.random.default_rng(seed)
    valid = rng.random(SHAPE[:2]) > 0.2
    still = np.zeros((*SHAPE[:2], 1, SHAPE[3]))
    parts = rng.normal(size=SHAPE), rng.normal(size=SHAPE), rng.normal(size=still.shape) if level else still
    return parts, valid, Course(*map(tensor, parts), tensor(valid))


def test_smoothness_is_the_mean_square_of_second_differences_where_three_ticks_count():
    (p, _, level), valid, made = course()
    value = p + level
    squares = [
        (value[b, t + 1] - 2 * value[b, t] + value[b, t - 1]) ** 2
        for b in range(SHAPE[0])
        for t in range(1, SHAPE[1] - 1)
        if valid[b, t - 1 : t + 2].all()
    ]
    assert len(squares) > 3
    assert Smoothness().evaluate(made).item() == pytest.approx(np.mean(squares), rel=1e-12)


def test_smoothness_is_zero_on_straight_lines():
    ramp = torch.arange(11.0).reshape(1, 11, 1, 1)
    made = Course(ramp, torch.zeros_like(ramp), 3.0 * ramp, torch.ones(1, 11, dtype=torch.bool))
    assert Smoothness().evaluate(made) == 0


def test_derivative_is_the_mean_square_of_the_errors_first_differences():
    (p, y, _), valid, made = course()
    e = p - y
    squares = [
        (e[b, t + 1] - e[b, t]) ** 2 for b in range(SHAPE[0]) for t in range(SHAPE[1] - 1) if valid[b, t : t + 2].all()
    ]
    assert Derivative().evaluate(made).item() == pytest.approx(np.mean(squares), rel=1e-12)


def test_drift_is_the_mean_square_of_the_running_sum_over_the_root_of_its_ticks():
    (p, y, _), valid, made = course()
    parts = []
    for b in range(SHAPE[0]):
        error = (p - y)[b][valid[b]]
        parts += list(np.cumsum(error, axis=0) ** 2 / np.arange(1, len(error) + 1)[:, None, None])
    assert Drift().evaluate(made).item() == pytest.approx(np.mean(parts), rel=1e-12)


def test_drift_grows_with_the_length_of_a_constant_error():
    def of(ticks):
        zeros = torch.zeros(1, ticks, 1, 1).double()
        return Drift().evaluate(Course(zeros + 0.1, zeros, zeros, torch.ones(1, ticks, dtype=torch.bool))).item()

    assert of(1) == pytest.approx(0.01)
    assert of(99) == pytest.approx(0.01 * 50)


def test_correlation_is_one_minus_that_of_numpy():
    (p, y, _), valid, made = course()
    wanted = [1 - np.corrcoef(p[valid][:, h, o], y[valid][:, h, o])[0, 1] for h in range(2) for o in range(4)]
    assert Correlation().evaluate(made).item() == pytest.approx(np.mean(wanted), rel=1e-6)


def test_correlation_passes_over_what_stands_still():
    (p, _, level), valid, _ = course()
    still = Course(tensor(p).requires_grad_(), torch.ones(SHAPE).double(), tensor(level), tensor(valid))
    loss = Correlation().evaluate(still)
    loss.backward()
    assert loss == 0
    assert torch.isfinite(still.predicted.grad).all()


@pytest.mark.parametrize("name", list(TERMS))
def test_terms_without_a_tick_that_counts_are_zero(name):
    (p, y, level), valid, _ = course()
    nothing = Course(tensor(p).requires_grad_(), tensor(y), tensor(level), tensor(np.zeros_like(valid)))
    loss = TERMS[name]().evaluate(nothing)
    loss.backward()
    assert loss == 0
    assert torch.isfinite(nothing.predicted.grad).all()


def test_horizons_decay_geometrically_with_mean_one():
    weights = horizon_weights(4, 0.5)
    wanted = 0.5 ** np.arange(4)
    np.testing.assert_allclose(weights[:, 0].numpy(), wanted / wanted.mean(), rtol=1e-6)
    assert torch.equal(horizon_weights(3, 1.0), torch.ones(3, 1))


def test_adaptive_weights_are_inverse_running_errors_cut_and_blended():
    spec = AdaptiveWeights(blend=0.3, max_ratio=3.0, decay=0.9)
    running = np.array([[1.0, 0.5, 0.1], [2.0, 2.0, 2.0]])
    inverse = np.minimum(1 / running, 3.0 * (1 / running).min(axis=1, keepdims=True))
    wanted = 0.7 + 0.3 * inverse / inverse.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(spec.weights(tensor(running)).numpy(), wanted, rtol=1e-12)
    error, valid = draw(2, 5, 2, 3), np.random.default_rng(1).random((2, 5)) > 0.5
    found = spec.follow(tensor(running), tensor(error), tensor(valid)).numpy()
    np.testing.assert_allclose(found, 0.9 * running + 0.1 * np.abs(error[valid]).mean(axis=0), rtol=1e-12)
    nothing = spec.follow(tensor(running), tensor(error), tensor(np.zeros_like(valid)))
    np.testing.assert_array_equal(nothing.numpy(), running)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Huber(delta=0.0), r"delta = 0\.0; 0 < delta <= 1,000,000 must hold"),
        (lambda: Focal(gamma=-1.0), r"gamma = -1\.0.*must hold"),
        (lambda: Focal(delta=-2.0), r"delta = -2\.0.*must hold"),
        (lambda: Heteroscedastic(beta=1.5), r"beta = 1\.5; 0 <= beta <= 1 must hold"),
        (lambda: Smoothness(weight=0.0), r"smoothness: weight = 0\.0; .* must hold"),
        (lambda: Derivative(weight=-0.1), r"derivative: weight = -0\.1"),
        (lambda: Correlation(weight=math.nan), "correlation: weight = nan"),
        (lambda: AdaptiveWeights(blend=2.0), r"blend = 2\.0.*must hold"),
        (lambda: AdaptiveWeights(max_ratio=1.0), r"max_ratio = 1\.0.*must hold"),
        (lambda: AdaptiveWeights(decay=1.0), r"decay = 1\.0.*must hold"),
    ],
)
def test_values_out_of_range_are_refused_with_the_value(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
