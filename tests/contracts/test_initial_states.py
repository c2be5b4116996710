"""Learned initial states: what they change, when, and that any split of a stream gives the same."""

import pytest
import torch

from edp.networks.cells import CELLS, Stack
from edp.networks.initial import INITIAL_STATES
from edp.networks.streaming import map_state, reset_where

LEARNED = [name for name in INITIAL_STATES if name != "zero"]
PREFIX = 6


def make(name, cell="lstm", seed=3):
    torch.manual_seed(seed)
    stack = Stack(CELLS[cell](), 3, 4, 2, 0.0)
    options = {"ticks": PREFIX, "hidden": 5} if name == "prefix" else {}
    net = INITIAL_STATES[name](**options).build(stack, 3).double().eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return net


def draw(batch, ticks):
    return torch.randn(batch, ticks, 3, dtype=torch.float64)


def run(net, x, state=None):
    with torch.no_grad():
        return net(x, net.initial_state(len(x), x) if state is None else state)


def test_zero_is_the_layers_themselves():
    stack = Stack(CELLS["gru"](), 3, 4, 1, 0.0)
    assert INITIAL_STATES["zero"]().build(stack, 3) is stack


@pytest.mark.parametrize("cell", list(CELLS))
def test_the_prefix_changes_nothing_before_its_end_and_the_state_at_it(cell):
    net, x = make("prefix", cell), draw(2, 15)
    found, plain = run(net, x)[0], run(net.recurrent, x)[0]
    torch.testing.assert_close(found[:, :PREFIX], plain[:, :PREFIX], rtol=0, atol=1e-12)
    assert not torch.allclose(found[:, PREFIX], plain[:, PREFIX], rtol=0, atol=1e-6)
    # From its end on it is the plain layer from the corrected state, written out.
    _, state = run(net.recurrent, x[:, :PREFIX])
    seen = torch.cat([x[:, :PREFIX].mean(dim=1), x[:, PREFIX - 1]], dim=1)
    with torch.no_grad():
        correction = net.second(torch.tanh(net.first(seen)))
    numbers = iter(correction.T)

    def corrected(part):
        rows = [next(numbers) for _ in range(part[0].numel())]
        return part + torch.stack(rows, dim=1).reshape(part.shape)

    wanted, _ = run(net.recurrent, x[:, PREFIX:], map_state(corrected, state))
    torch.testing.assert_close(found[:, PREFIX:], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("sizes", [[1] * 20, [PREFIX, 14], [PREFIX - 1, 2, 13], [3, 3, 14], [19, 1]])
def test_any_split_gives_the_same(name, sizes):
    net, x = make(name), draw(2, 20)
    whole, state, rows = run(net, x)[0], None, []
    for piece in x.split(sizes, dim=1):
        y, state = run(net, piece, state)
        rows.append(y)
    torch.testing.assert_close(torch.cat(rows, dim=1), whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", LEARNED)
def test_streams_reset_at_different_times_each_get_their_own(name):
    net, x = make(name), draw(2, 24)
    _, state = run(net, x[:, :4])
    state = reset_where(torch.tensor([False, True]), net.initial_state(2, x), state)
    found, _ = run(net, x[:, 4:], state)
    torch.testing.assert_close(found[0], run(net, x[:1])[0][0, 4:], rtol=0, atol=1e-12)
    torch.testing.assert_close(found[1], run(net, x[1:, 4:])[0][0], rtol=0, atol=1e-12)


def test_a_learned_constant_is_where_every_stream_begins():
    net = make("constant")
    state = net.initial_state(3, draw(3, 1))
    numbers = torch.cat([part.flatten(1) for layer in state for part in layer], dim=1)
    torch.testing.assert_close(numbers, net.constant.detach().expand(3, -1), rtol=0, atol=0)
    fresh = INITIAL_STATES["constant"]().build(Stack(CELLS["gru"](), 3, 4, 1, 0.0), 3)
    assert not fresh.constant.detach().any()


@pytest.mark.long
@pytest.mark.parametrize("name", LEARNED)
def test_gradients_are_right(name):
    net, x = make(name), draw(2, 9)

    def loss(*_):
        return net(x, net.initial_state(2, x))[0].square().sum()

    assert torch.autograd.gradcheck(loss, tuple(net.parameters()))
