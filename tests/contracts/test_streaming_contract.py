"""What every network that the registries allow must do: shapes, causality, streams, gradients, costs."""

import copy

import numpy as np
import torch

from edp.export.golden import random_inputs
from edp.networks.stream import Stream
from edp.networks.streaming import detach_state, map_state, reset_where, state_numbers

TICKS = 24


def inputs(predictor, batch=2, ticks=TICKS, seed=0):
    like = next(predictor.parameters())
    draw = torch.Generator().manual_seed(seed)
    return torch.randn(batch, ticks, predictor.front.inputs, generator=draw, dtype=like.dtype)


def run(predictor, x, state=None):
    with torch.no_grad():
        return predictor(x, predictor.initial_state(len(x), x) if state is None else state)


def test_shapes_and_dtype(structure, form, predictor_of):
    predictor = predictor_of(structure, form, torch.float32)
    x = inputs(predictor)
    code, state = run(predictor, x)
    with torch.no_grad():
        physical, _ = predictor.predict(x, predictor.initial_state(2, x))
        again = predictor.code.encode(physical, predictor.front(x, predictor.front.initial_state(2, x))[0])
    assert code.shape == physical.shape == (2, TICKS, len(form[1]), 2)
    assert code.dtype == torch.float32
    assert torch.isfinite(code).all()
    torch.testing.assert_close(again, code, rtol=1e-4, atol=1e-5)
    fresh = predictor.initial_state(2, x)
    assert map_state(lambda tensor: (tensor.shape, tensor.dtype), fresh) == map_state(
        lambda tensor: (tensor.shape, tensor.dtype), state
    )
    assert state_numbers(state) == state_numbers(fresh)


def test_the_future_does_not_reach_the_past(structure, predictor_of):
    predictor = predictor_of(structure)
    x = inputs(predictor)
    cut = 13
    changed = x.clone()
    changed[:, cut:] = 50.0 * inputs(predictor, seed=1)[:, cut:]
    before, after = run(predictor, x)[0], run(predictor, changed)[0]
    torch.testing.assert_close(after[:, :cut], before[:, :cut], rtol=0, atol=1e-12)
    assert not torch.equal(after[:, cut], before[:, cut])


def test_a_step_a_chunk_and_a_window_agree_at_the_last_sample(structure, predictor_of):
    predictor = predictor_of(structure)
    window = predictor.spec.window
    # In the usual range: what is far outside may overflow the single precision of a stream, which then restarts.
    x = torch.from_numpy(random_inputs(predictor, window, seed=0)).to(next(predictor.parameters())).unsqueeze(0)
    with torch.no_grad():
        whole, _ = predictor.predict(x, predictor.initial_state(1, x))
        _, state = predictor.predict(x[:, : window - 4], predictor.initial_state(1, x))
        chunk, _ = predictor.predict(x[:, window - 4 :], state)
    stream = Stream(predictor)
    for row in x[0]:
        assert not stream.warm
        step = stream.step(row)
    assert stream.warm
    torch.testing.assert_close(chunk[:, -1], whole[:, -1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(step.prediction, whole[0, -1].float().numpy(), rtol=1e-6, atol=1e-7)


def test_reset_forgets_everything_in_the_streams_it_is_asked_for(structure, predictor_of):
    predictor = predictor_of(structure)
    x, later = inputs(predictor), inputs(predictor, seed=2)
    _, state = run(predictor, x)
    mixed = reset_where(torch.tensor([True, False]), predictor.initial_state(2, x), detach_state(state))
    found = run(predictor, later, mixed)[0]
    torch.testing.assert_close(found[:1], run(predictor, later[:1])[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(found[1], run(predictor, later, state)[0][1], rtol=0, atol=1e-12)
    assert not torch.allclose(found[1], run(predictor, later)[0][1], rtol=0, atol=1e-6)


def test_running_does_not_change_the_state_that_came(structure, predictor_of):
    predictor = predictor_of(structure)
    _, state = run(predictor, inputs(predictor))
    copies = map_state(torch.clone, state)
    run(predictor, inputs(predictor, seed=3), state)
    map_state(lambda old, new: torch.testing.assert_close(new, old, rtol=0, atol=0), copies, state)


def test_evaluation_is_deterministic_and_training_with_dropout_is_not(structure, predictor_of):
    predictor = predictor_of(structure, dtype=torch.float32)
    x = inputs(predictor)
    first = run(predictor, x)[0]
    torch.manual_seed(99)
    assert torch.equal(run(predictor, x)[0], first)
    other = copy.deepcopy(predictor)
    assert torch.equal(run(other, x)[0], first)
    if predictor.spec.backbone.dropout:
        assert not torch.equal(run(other.train(), x)[0], first)


def test_streams_of_a_batch_do_not_meet(structure, predictor_of):
    predictor = predictor_of(structure)
    x = inputs(predictor, batch=4)
    together = run(predictor, x)[0]
    for i in range(4):
        torch.testing.assert_close(together[i : i + 1], run(predictor, x[i : i + 1])[0], rtol=0, atol=1e-12)


def test_gradients_reach_every_parameter(structure, form, predictor_of):
    predictor = predictor_of(structure, form)
    torch.manual_seed(5)
    x = inputs(predictor, batch=4)
    code, _ = predictor(x, predictor.initial_state(4, x))
    # An error of the size of a standard deviation, however far a physics base goes on inputs drawn at random.
    loss = (code - code.detach() - torch.randn(code.shape, dtype=code.dtype)).square().sum()
    learned = {name: parameter for name, parameter in predictor.named_parameters() if parameter.requires_grad}
    fixed = {name for name, _ in predictor.named_parameters()} - set(learned)
    bypass = getattr(predictor.bypass, "spec", None)
    assert fixed == (set() if bypass is None or bypass.trained else {"bypass.weight", "bypass.bias"})
    for name, gradient in zip(learned, torch.autograd.grad(loss, list(learned.values())), strict=True):
        if name.endswith("pooling.score.bias"):
            # A softmax does not notice a shift of all scores; the thesis counts this bias, so it is kept.
            assert gradient.abs().max() < 1e-9
        else:
            assert gradient.abs().sum() > 1e-9, name


def test_cost_rows_count_every_parameter(structure, form, predictor_of):
    predictor = predictor_of(structure, form)
    rows = predictor.costs()
    assert sum(row.parameters for row in rows) == sum(parameter.numel() for parameter in predictor.parameters())
    gains = sum(p.numel() for name, p in predictor.named_parameters() if name.endswith((".gain", "activation.free")))
    assert sum(row.foldable for row in rows) == gains
    assert all(row.width_in > 0 or row.width_out > 0 for row in rows)
