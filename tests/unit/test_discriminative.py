"""Learning rates by part of the network."""

import pytest

from edp.networks.predictor import build_model
from edp.training.optimizers import Discriminative

pytestmark = pytest.mark.long


def test_each_part_has_its_rate_and_matrices_alone_decay(tiny, tiny_model):
    net = build_model(tiny.task, tiny_model, tiny.scaler(), seed=0)
    rates = (("backbone.recurrent", 2e-5), ("backbone", 1e-5), ("back", 9.0))
    groups = (
        Discriminative(rates=rates, learning_rate=3e-4, weight_decay=0.1).build(net.named_parameters()).param_groups
    )
    rate = {parameter: (group["lr"], group["weight_decay"]) for group in groups for parameter in group["params"]}
    for name, parameter in net.named_parameters():
        recurrent, inside = name.startswith("backbone.recurrent."), name.startswith("backbone.")
        decay = 0.1 if parameter.ndim > 1 and "bias" not in name else 0.0
        assert rate[parameter] == (2e-5 if recurrent else 1e-5 if inside else 3e-4, decay), name
    assert groups[0]["lr"] == 3e-4
