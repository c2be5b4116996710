"""Trainings on two domains: equal shares, what is taught, reversed gradients, and that they go on after a stop."""

import dataclasses

import numpy as np
import pytest
import torch

from edp.data.chunks import ChunkSampler
from edp.errors import ConfigError
from edp.networks.predictor import build_model
from edp.networks.running import stream_predictions
from edp.training.fit import fit
from edp.training.transfer.both_domains import BothDomains, BothSpec, Classifier, ramp, reverse
from edp.workflows.transfer.methods import share


@pytest.fixture(scope="module")
def start(tiny, tiny_model):
    return build_model(tiny.task, tiny_model, tiny.scaler(), seed=5).eval()


def kept(tiny):
    return [dataclasses.replace(part, name=f"kept {part.name}") for part in (*tiny.train, *tiny.validation)] * 3


def test_both_domains_have_equal_shares_and_the_network_of_the_source_teaches_its_own(tiny, start):
    strategy = BothDomains(start, kept(tiny), BothSpec(soft=0.5))
    found = strategy.series(tiny.task, tiny.train)
    ticks = {name: sum(p.samples for p in found if p.name.startswith("kept") == name) for name in (True, False)}
    assert max(ticks.values()) <= 1.5 * min(ticks.values())
    for part in found:
        assert part.strategy_columns is not None
        assert np.all(part.strategy_columns[:, 0] == (1.0 if part.name.startswith("kept") else 0.0))
        assert part.strategy_columns.shape == (part.samples, 1 + 2 * 3)
        if part.name.startswith("kept"):
            said = stream_predictions(start, [part])[0].reshape(part.samples, -1)
            np.testing.assert_allclose(part.strategy_columns[:, 1:], said, atol=1e-6)


def test_worlds_meet_in_a_batch(tiny, start, tiny_training):
    series = BothDomains(start, kept(tiny), BothSpec()).series(tiny.task, tiny.train)
    sampler = ChunkSampler(
        series, tiny.task.horizons, dataclasses.replace(tiny_training.chunks, reset_after_chunks=2), 0
    )
    shares = [batch.strategy_columns[..., 0].mean() for batch in sampler.epoch(0) if batch.strategy_columns is not None]
    assert 0.2 < np.mean(shares) < 0.8


def test_a_reversed_gradient_is_that_of_the_other_direction():
    x = torch.randn(4, 3, requires_grad=True)
    y = reverse(x, 0.25)
    assert torch.equal(x, y)
    (3.0 * y).sum().backward()
    assert torch.allclose(x.grad, torch.full_like(x, -0.75))


def test_the_adversary_comes_in_slowly():
    assert ramp(0.0) == 0.0
    assert ramp(0.1) < 0.5 < ramp(0.2) < ramp(1.0) < 1.0
    assert ramp(1.0) == pytest.approx(0.9999, abs=1e-4)


def test_the_classifier_learns_while_the_network_hides(tiny, start):
    """One step: the classifier goes down its loss, the representation up."""
    torch.manual_seed(0)
    classifier, hidden = Classifier(16), torch.randn(8, 20, 16, requires_grad=True)
    strategy = BothDomains(start, kept(tiny), BothSpec(reversal=1.0))
    here = torch.zeros(8, 20, dtype=torch.bool)
    here[:4] = True
    plain = strategy._confusion(classifier(hidden), here, ~here)
    down = torch.autograd.grad(plain, [hidden, *classifier.parameters()])
    turned = strategy._confusion(classifier(reverse(hidden, 0.5)), here, ~here)
    other = torch.autograd.grad(turned, [hidden, *classifier.parameters()])
    assert torch.allclose(other[0], -0.5 * down[0])
    for mine, its in zip(other[1:], down[1:], strict=True):
        assert torch.equal(mine, its)
    nothing = torch.zeros_like(here)
    assert float(strategy._confusion(classifier(hidden), nothing, nothing).detach()) == 0.0


def test_the_classifier_is_taken_away_and_the_progress_is_told(tiny, tiny_model, tiny_training, start):
    strategy = BothDomains(start, kept(tiny), BothSpec(reversal=0.5))
    seen = []
    inner = strategy.loss
    strategy.loss = lambda objective, batch_context: (
        seen.append(batch_context.progress) or inner(objective, batch_context)
    )  # type: ignore[method-assign]
    spec = dataclasses.replace(tiny_training, epochs=2, updates=4)
    net = fit(tiny, tiny_model, spec, strategy=strategy).predictor
    assert seen == [i / 8 for i in range(8)]
    assert not hasattr(net, "classifier")
    assert net.state_dict().keys() == start.state_dict().keys()


@pytest.mark.parametrize("change", [{"weight": 0.0}, {"soft": 1.5}, {"reversal": -1.0}])
def test_options_out_of_range_are_refused(change):
    with pytest.raises(ConfigError, match="must hold"):
        BothSpec(**change)


def test_what_chooses_the_best_epoch_is_spread_over_the_recordings(tiny):
    series = [*tiny.train, *tiny.validation, *tiny.test]
    some = share(series, 300, 100)
    assert [part.name for part in some] == [series[0].name, series[1].name, series[2].name]
    assert all(part.samples == 100 for part in some)
    assert [part.samples for part in share(series, 50, 100)] == [100]
    assert len(share(series, 10_000, 100)) == 4
