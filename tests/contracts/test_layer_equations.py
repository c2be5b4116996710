"""Layers against the equations written out: convolution, LSTM, pooling, residual, activations."""

import math

import pytest
import torch

from edp.networks.activations import ACTIVATIONS, ScaledTanh
from edp.networks.blocks import BLOCKS
from edp.networks.convolution import CausalConv, ConvolutionStack, TemporalBlock, receptive_field
from edp.networks.heads import MlpHead
from edp.networks.pooling import AttentionPooling


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(4)


def run(module, x):
    module = module.double().eval()
    with torch.no_grad():
        return module(x, module.initial_state(len(x), x))[0]


def draw(*shape):
    return torch.randn(*shape, dtype=torch.float64)


@pytest.mark.parametrize(("kernel", "dilation"), [(1, 1), (3, 1), (3, 4), (2, 7)])
def test_convolution_is_eq_2_8(kernel, dilation):
    layer, x = CausalConv(3, 2, kernel, dilation), draw(2, 20, 3)
    with torch.no_grad():
        layer.gain.mul_(1.7)
    found = run(layer, x)
    v, gain, bias = layer.direction, layer.gain, layer.bias
    for t in range(20):
        for o in range(2):
            total = bias[o].clone()
            for i in range(kernel):
                if t - dilation * i >= 0:
                    # conv1d keeps the newest sample last; eq. 2.8 counts i back in time.
                    w = gain[o] * v[o, :, kernel - 1 - i] / v[o].norm()
                    total = total + x[:, t - dilation * i] @ w
                else:
                    total = total + torch.zeros(2).double()
            torch.testing.assert_close(found[:, t, o], total.expand(2), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("into", "out"), [(3, 3), (3, 5)])
def test_temporal_block_adds_its_input(into, out):
    block, x = TemporalBlock(into, out, 3, 2, dropout=0.5).double(), draw(1, 15, into)
    inner = torch.relu(run(block.second, torch.relu(run(block.first, x))))
    with torch.no_grad():
        path = x if into == out else x @ block.shortcut.weight.T + block.shortcut.bias
    torch.testing.assert_close(run(block, x), inner + path, rtol=0, atol=1e-12)
    assert (block.shortcut is None) == (into == out)


@pytest.mark.parametrize(("levels", "kernel"), [(1, 5), (3, 2), (2, 4)])
def test_receptive_field_is_what_a_stack_sees(levels, kernel):
    stack = ConvolutionStack(1, (3,) * levels, kernel, 1, 0.0).double().eval()
    with torch.no_grad():
        for name, parameter in stack.named_parameters():
            parameter.copy_(parameter.abs() + 0.1 if "bias" not in name else parameter.abs())
    reach = receptive_field(levels, kernel)
    x = torch.ones(1, reach + 5, 1, dtype=torch.float64)
    base = run(stack, x)[0, -1]
    seen = []
    for back in range(reach + 5):
        changed = x.clone()
        changed[0, -1 - back] = 2.0
        seen.append(not torch.equal(run(stack, changed)[0, -1], base))
    assert seen == [True] * reach + [False] * 5


@pytest.mark.parametrize(("window", "ticks"), [(1, 10), (5, 3), (5, 40), (50, 300)])
def test_pooling_is_eq_3_33_over_the_trailing_window(window, ticks):
    layer, h = AttentionPooling(3, window), draw(2, ticks, 3)
    found = run(layer, h)
    w = layer.score.weight[0].detach()
    for t in range(ticks):
        past = h[:, max(0, t - window + 1) : t + 1]
        share = torch.exp(past @ w)
        share = share / share.sum(dim=1, keepdim=True)
        pooled = sum(share[:, s : s + 1] * past[:, s] for s in range(past.shape[1]))
        torch.testing.assert_close(found[:, t], torch.cat([pooled, h[:, t]], dim=-1), rtol=0, atol=1e-12)


def test_pooling_stands_large_scores():
    layer, h = AttentionPooling(2, 4), 1e4 * draw(1, 12, 2)
    assert torch.isfinite(run(layer, h)).all()


def test_the_difference_is_that_of_neighbouring_states():
    x = draw(1, 9, 3)
    found = run(BLOCKS["temporal_difference"]().build(3, 5), x)
    torch.testing.assert_close(found[:, 1:], x[:, 1:] - x[:, :-1], rtol=0, atol=0)
    assert torch.equal(found[:, 0], x[:, 0])


@pytest.mark.parametrize("kind", ["diagonal", "linear"])
def test_the_gate_scales_each_outputs_view(kind):
    gate, h = BLOCKS["cylinder_gate"](form=kind).build(4, 3), draw(1, 6, 4)
    found = run(gate, h)
    open_share = found / h.unsqueeze(-2)
    assert found.shape == (1, 6, 3, 4)
    assert ((open_share > 0) & (open_share < 1)).all()
    if kind == "diagonal":
        wanted = torch.sigmoid(gate.scale * h.unsqueeze(-2) + gate.bias) * h.unsqueeze(-2)
    else:
        wanted = torch.sigmoid(gate.gate(h)).reshape(1, 6, 3, 4) * h.unsqueeze(-2)
    torch.testing.assert_close(found, wanted.detach(), rtol=0, atol=1e-12)


def test_parallel_stacks_stand_side_by_side():
    def make(dilation):
        return ConvolutionStack(2, (3,), 3, dilation, 0.0)

    both, x = BLOCKS["multi_scale_tcn"](first_dilations=(1, 8)).build(make), draw(1, 30, 2)
    found = run(both, x)
    torch.testing.assert_close(found[..., :3], run(both.branches[0], x), rtol=0, atol=0)
    torch.testing.assert_close(found[..., 3:], run(both.branches[1], x), rtol=0, atol=0)
    assert both.branches[1].levels[0].first.dilation == 8


@pytest.mark.parametrize("gated", [False, True])
def test_each_head_is_its_own_small_network(gated):
    heads = MlpHead(hidden=5, layers=2).build(4, 3, 2)
    x = draw(2, 6, 3, 4) if gated else draw(2, 6, 4)
    found = run(heads, x)
    assert found.shape == (2, 6, 2, 3)
    for c in range(3):
        y = x[:, :, c] if gated else x
        for layer in range(3):
            y = torch.relu(y) if layer else y
            y = y @ heads.weights[layer][c] + heads.biases[layer][c]
        torch.testing.assert_close(found[..., c], y.detach(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", list(ACTIVATIONS))
def test_activations_keep_their_bound(name):
    spec = ACTIVATIONS[name]()
    x = torch.linspace(-50, 50, 101).repeat(3, 1).T
    y = spec.build(3)(x)
    assert y.shape == x.shape
    if spec.bound() is None:
        assert torch.equal(y, x)
    else:
        assert y.abs().max() <= spec.bound() + 1e-6
    assert (y.diff(dim=0) >= 0).all()


def test_stanh_starts_at_its_amplitude_and_keeps_its_limits():
    layer = ScaledTanh(start=2.5, low=1.01, high=5.0).build(2)
    torch.testing.assert_close(layer.amplitude(), torch.full((2,), 2.5))
    torch.testing.assert_close(layer(torch.tensor([0.3, -2.0])), 2.5 * torch.tanh(torch.tensor([0.3, -2.0])))
    with torch.no_grad():
        layer.free.copy_(torch.tensor([-80.0, 80.0]))
    amplitude = layer.amplitude().tolist()
    assert math.isclose(amplitude[0], 1.01, rel_tol=1e-6)
    assert math.isclose(amplitude[1], 5.0, rel_tol=1e-6)
