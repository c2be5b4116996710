import pytest
import torch

from edp.errors import ConfigError
from edp.losses import LOSSES, Huber, MeanSquared, masked_loss, output_weights

ERRORS = torch.arange(-120, 121, dtype=torch.float64) / 20


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


@pytest.mark.parametrize("name", list(LOSSES))
def test_every_loss_is_zero_at_zero_even_and_rising(name):
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
    found = masked_loss(MeanSquared(), prediction, target, valid, weights)
    rows = [(prediction[0, t] - target[0, t]).square() * weights for t in (0, 2, 3)]
    torch.testing.assert_close(found, torch.stack(rows).mean())


def test_ticks_that_do_not_count_give_no_gradient():
    prediction = torch.zeros(1, 4, 1, 1, requires_grad=True)
    valid = torch.tensor([[False, True, False, True]])
    masked_loss(Huber(), prediction, torch.ones(1, 4, 1, 1), valid, torch.ones(1)).backward()
    assert prediction.grad.flatten().tolist() == [0.0, -0.5, 0.0, -0.5]


def test_a_batch_without_valid_ticks_costs_nothing():
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    loss = masked_loss(Huber(), torch.ones(2, 3, 1, 1), torch.zeros(2, 3, 1, 1), nothing, torch.ones(1))
    assert loss == 0


def test_a_threshold_of_zero_is_refused():
    with pytest.raises(ConfigError, match="delta > 0 must hold"):
        Huber(delta=0.0)
