"""Rounding within every network that the registries allow: the streaming contract, gradients, what is left."""

import copy

import numpy as np
import pytest
import torch

from edp.data.series import Series
from edp.errors import ConfigError
from edp.ir.layers import Dense, GroupedDense
from edp.ir.memory import AttentionPool, Convolution, Gru, LayerNormLstm, Lstm, PrefixCorrection
from edp.workflows.compression import NetworkRounding, RoundingSpec, weight_levels

TICKS = 24
WEIGHTS = {
    Dense: ("weight",),
    GroupedDense: ("weight",),
    Convolution: ("weight",),
    Lstm: ("weight_x", "weight_h"),
    LayerNormLstm: ("weight_x", "weight_h"),
    Gru: ("weight_x", "weight_h"),
    AttentionPool: ("score",),
    PrefixCorrection: ("first_weight", "second_weight"),
}


@pytest.fixture
def predictor_of(predictor_of):
    """Copies: other tests share the predictors, and here weights change."""
    return lambda structure: copy.deepcopy(predictor_of(structure))


def series_of(predictor, ticks=200):
    draw = np.random.default_rng(0)
    inputs = draw.normal(size=(ticks, predictor.front.inputs)).astype(np.float32)
    return [Series("drawn", inputs, inputs[:, :2].copy())]


def rounded(predictor, bits):
    rounding = NetworkRounding(predictor, bits)
    rounding.install(series_of(predictor))
    return rounding


def inputs(predictor):
    like = next(predictor.parameters())
    return torch.randn(2, TICKS, predictor.front.inputs, generator=torch.Generator().manual_seed(3)).to(like)


def run(predictor, x, state=None):
    with torch.no_grad():
        return predictor(x, predictor.initial_state(len(x), x) if state is None else state)


@pytest.mark.covering
def test_a_rounded_network_obeys_the_streaming_contract_and_is_left_as_it_was(structure, predictor_of):
    predictor = predictor_of(structure)
    before = copy.deepcopy(predictor.state_dict())
    x = inputs(predictor)
    plain = run(predictor, x)[0]
    rounding = rounded(predictor, 8)
    whole, state, pieces = run(predictor, x)[0], None, []
    for start, stop in ((0, 1), (1, 8), (8, 9), (9, TICKS)):
        y, state = run(predictor, x[:, start:stop], state)
        pieces.append(y)
    torch.testing.assert_close(torch.cat(pieces, dim=1), whole, rtol=0, atol=1e-9 * float(whole.abs().max()))
    assert not torch.equal(whole, plain)
    rounding.remove()
    assert torch.equal(run(predictor, x)[0], plain)
    after = copy.deepcopy(predictor).state_dict()
    assert list(after) == list(before)
    assert all(torch.equal(value, before[name]) for name, value in after.items())


@pytest.mark.covering
def test_what_is_left_lies_on_the_grid_of_a_static_quantisation(structure, predictor_of):
    """Every weight of a graph's multiply-accumulates, with a step for each output row, folded ones too."""
    predictor = predictor_of(structure)
    x = inputs(predictor)
    rounding = rounded(predictor, 0)
    seen = run(predictor, x)[0]
    rounding.remove()
    rounding.keep()
    torch.testing.assert_close(run(predictor, x)[0], seen, rtol=0, atol=1e-9 * float(seen.abs().max()))
    for layer in predictor.float().graph().layers:
        kinds = WEIGHTS.get(type(layer))
        assert kinds is not None or not layer.tensors().keys() & {"weight", "weight_x", "weight_h"}
        for name in kinds or ():
            weight = getattr(layer, name)
            axes = (0, 1) if isinstance(layer, GroupedDense) else () if weight.ndim == 1 else (0,)
            levels, steps = weight_levels(torch.from_numpy(weight), axes)
            exact = torch.from_numpy(weight) / steps
            torch.testing.assert_close(exact, levels, rtol=0, atol=2e-3)


@pytest.mark.covering
def test_gradients_are_those_of_the_rounded_weights(structure, predictor_of):
    """Straight through: the gradient at the rounded weights, as if they were the ones that training moves."""
    predictor = predictor_of(structure)
    x = inputs(predictor)

    def gradients():
        predictor.zero_grad(set_to_none=True)
        predictor(x, predictor.initial_state(2, x))[0].square().mean().backward()
        return {name: p.grad for name, p in predictor.named_parameters() if p.grad is not None}

    rounding = rounded(predictor, 0)
    found = gradients()
    rounding.remove()
    rounding.keep()
    plain = gradients()
    assert set(found) == set(plain)
    for name, value in plain.items():
        torch.testing.assert_close(found[name], value, rtol=1e-6, atol=1e-9 * float(value.abs().max()), msg=name)


def test_other_bits_are_refused():
    with pytest.raises(ConfigError, match="activation_bits = 12; 16, 8 or 0"):
        RoundingSpec(activation_bits=12)
