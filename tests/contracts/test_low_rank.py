"""Low-rank changes of every network that the registries allow: nothing at first, then the same in place and added."""

import copy

import pytest
import torch

from edp.training.spec import TrainingSpec
from edp.training.transfer.strategies import LowRank


@pytest.mark.covering
def test_changes_begin_at_nothing_and_are_added_at_the_end(structure, predictor_of, rows_of):
    start = predictor_of(structure)
    net = copy.deepcopy(start)
    x = torch.from_numpy(rows_of(start, ticks=30)).double().unsqueeze(0)

    def answer(which):
        with torch.no_grad():
            return which(x, which.initial_state(1, x))[0]

    before = answer(start)
    strategy = LowRank(start, rank=2)
    assert strategy.begin(net, TrainingSpec())
    torch.testing.assert_close(answer(net), before, rtol=1e-12, atol=1e-12)
    learned = [name for name, parameter in net.named_parameters() if parameter.requires_grad]
    assert learned
    assert all(name.startswith("adapters.") for name in learned)
    draw = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for change in net.adapters:
            change.b.copy_(0.1 * torch.randn(change.b.shape, generator=draw, dtype=torch.float64))
    changed = answer(net)
    assert not torch.allclose(changed, before)
    strategy.end(net)
    assert net.state_dict().keys() == start.state_dict().keys()
    torch.testing.assert_close(answer(net), changed, rtol=1e-9, atol=1e-9)
    wanted = {name for name, parameter in start.named_parameters() if parameter.requires_grad}
    assert {name for name, parameter in net.named_parameters() if parameter.requires_grad} == wanted


@pytest.mark.parametrize("backbone", ["hybrid", "lstm"])
def test_the_same_seed_draws_the_same_changes(backbone, predictor_of):
    start = predictor_of(backbone)
    made = []
    for seed in (3, 3, 4):
        net = copy.deepcopy(start)
        LowRank(start, rank=2).begin(net, TrainingSpec(seed=seed))
        made.append(torch.cat([change.a.flatten() for change in net.adapters]))
    assert torch.equal(made[0], made[1])
    assert not torch.equal(made[0], made[2])
