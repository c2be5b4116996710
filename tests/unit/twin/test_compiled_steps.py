"""The compiled loop against the same cell written plainly in PyTorch: values, and all gradients by autograd."""

import numpy as np
import pytest
import torch

from edp.networks.twin.recurrent_cell import Bounds, TwinNetwork
from edp.networks.twin.steps import _tanh
from edp.testing.twin_cell import plain_steps

TICKS, BATCH, COMMANDS, VELOCITIES, PRESSURES, UNITS = 40, 5, 3, 2, 3, 8


def case(strokes, tight, pulled):
    """A network with random weights, and inputs with every mixture of free and measured ports."""
    generator = torch.Generator().manual_seed(3)
    answers = VELOCITIES + strokes + PRESSURES
    network = TwinNetwork(COMMANDS, answers, UNITS, VELOCITIES + PRESSURES if pulled else 0)
    for name, weight in network.named_parameters():
        if name != "pull":
            weight.data.normal_(0, 0.4, generator=generator)
    if pulled:
        network.pull.data.copy_(torch.tensor([0.3, 0.9, 0.0, 1.0, 0.5]))

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    size = 0.6 if tight else 50.0
    low, high = np.full(answers, -size, np.float32), np.full(answers, size, np.float32)
    trapezoid = np.full(strokes, 0.3, np.float32)
    bounds = Bounds(np.full(answers, 0.4, np.float32), low, high, trapezoid, VELOCITIES)
    port = (torch.rand(TICKS, BATCH, answers, generator=generator) < 0.3).float()
    inputs = [draw(TICKS, BATCH, COMMANDS), 0.3 * draw(TICKS, BATCH, answers), port]
    start = (0.3 * draw(BATCH, answers), 0.3 * draw(BATCH, UNITS))
    target = draw(TICKS, BATCH, answers)
    mapped = None
    if pulled:
        mapped = draw(TICKS, BATCH, answers)
        mapped[..., VELOCITIES : VELOCITIES + strokes] = 0.0
    return network, inputs, start, bounds, mapped, target


@pytest.mark.parametrize("pulled", [False, True], ids=["alone", "map"])
@pytest.mark.parametrize("strokes", [VELOCITIES, 0], ids=["strokes", "no_strokes"])
@pytest.mark.parametrize("tight", [True, False], ids=["bounds_act", "bounds_far"])
def test_values_and_gradients_are_those_of_autograd(strokes, tight, pulled):
    network, (commands, measured, port), start, bounds, mapped, target = case(strokes, tight, pulled)
    results = []
    for run in (network, lambda *a: plain_steps(network, *a)):
        leaves = [commands.clone().requires_grad_(), *(values.clone().requires_grad_() for values in start)]
        answers, h = run(leaves[0], measured, port, (leaves[1], leaves[2]), bounds, mapped)
        loss = (answers - target).square().sum() + 3 * answers[-1].sum() + h.square().sum()
        grads = torch.autograd.grad(loss, [*leaves, *network.parameters()])
        results.append((answers.detach(), h.detach(), *grads))
    names = ["answers", "h", "by commands", "by answer", "by h", *(name for name, _ in network.named_parameters())]
    for name, compiled, plain in zip(names, *results, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=2e-4, atol=2e-4 * float(plain.abs().max()), msg=name)


def test_bounds_act_in_the_case_that_claims_it():
    network, (commands, measured, port), start, bounds, _, _ = case(VELOCITIES, True, False)
    answers, _ = network(commands, measured, port, start, bounds)
    strokes, velocities = answers[..., VELOCITIES : 2 * VELOCITIES], answers[..., :VELOCITIES]
    at_stop = strokes.abs() == 0.6
    assert at_stop.any()
    assert (velocities == 0).any()
    assert (velocities[at_stop] * strokes[at_stop] <= 0).all()
    assert answers.abs().max() <= 0.6


def test_the_rational_tanh_is_within_single_precision():
    x = np.linspace(-20, 20, 40_001, dtype=np.float32)
    assert np.abs([_tanh(value) - np.tanh(np.float64(value)) for value in x]).max() < 4e-7
