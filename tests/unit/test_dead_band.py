"""Dead bands of predictions: where left-out rows choose one, what it computes, and that every graph has it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edp.data.task import TargetMode
from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead, OutputBand
from edp.networks.outputs import Quantiles
from edp.networks.predictor import ModelSpec, check_combination
from edp.testing.networks import small_network, small_task
from edp.training.bagging.dead_band import band, dead_bands


def resting(rng, ticks=5000, noise=0.15):
    """Changes of a machine that rests nine tenths of the time, and predictions with an error everywhere."""
    moves = np.repeat(rng.random(ticks // 50) < 0.1, 50)
    truth = np.where(moves, rng.normal(0, 3, ticks), 0.0)
    return truth + noise * rng.normal(size=ticks), truth


def owner_of(ticks):
    return np.arange(ticks) * 5 // ticks


def test_small_predictions_count_as_none_where_that_is_true():
    rng = np.random.default_rng(0)
    predicted, truth = resting(rng)
    (width,) = dead_bands(predicted[:, None], truth[:, None], owner_of(len(truth)))
    assert 0.1 <= width <= 0.56
    behind = band(predicted, width)
    assert np.abs(behind - truth).mean() < 0.7 * np.abs(predicted - truth).mean()
    assert np.sqrt(np.square(behind - truth).mean()) < 1.003 * np.sqrt(np.square(predicted - truth).mean())


def test_there_is_none_where_noise_moves_all_the_time_and_where_nothing_moves():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(4000, 1))
    assert dead_bands(truth + 0.1 * rng.normal(size=truth.shape), truth, owner_of(4000)) == [0.0]
    still = np.zeros((4000, 1))
    assert dead_bands(still, still, owner_of(4000)) == [0.0]


def test_a_stretch_that_would_lose_narrows_it():
    rng = np.random.default_rng(0)
    predicted, truth = resting(rng)
    before = dead_bands(predicted[:, None], truth[:, None], owner_of(len(truth)))
    moving = slice(2000, 3000)
    truth[moving] = np.repeat(0.15 * rng.choice([-1.0, 1.0], 100), 10)
    predicted[moving] = truth[moving] + 0.01 * rng.normal(size=1000)
    assert dead_bands(predicted[:, None], truth[:, None], owner_of(len(truth))) < before / 2


def test_it_is_zero_then_steep_then_nothing_at_all():
    module = OutputBand(2, 1)
    module.width.copy_(torch.tensor([[0.5], [0.0]]))
    y = torch.tensor([-2.0, -1.0, -0.75, -0.5, -0.1, 0.0, 0.4, 0.6, 1.0, 3.0])
    behind = module(torch.stack([y, y], dim=-1).unsqueeze(-1)).squeeze(-1)
    np.testing.assert_allclose(behind[:, 0], [-2.0, -1.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.2, 1.0, 3.0], atol=1e-6)
    assert torch.equal(behind[:, 1], y)
    np.testing.assert_allclose(behind[:, 0], band(y.numpy(), 0.5), atol=1e-6)


def test_it_adds_nothing_to_a_graph_where_no_width_is_above_zero():
    backbone = CommitteeSpec(lags=(1, 3), members=2, units=4, layers=1)
    banded, plain = (
        ModelSpec(backbone=backbone, head=LinearHead(dead_band=on), window=8, blocks=()) for on in (True, False)
    )
    nets = [small_network(model, small_task(model, (1, 4), TargetMode.DELTA)) for model in (banded, plain)]
    assert len(nets[0].graph().layers) == len(nets[1].graph().layers) + 5
    nets[0].heads.band.width.zero_()
    assert len(nets[0].graph().layers) == len(nets[1].graph().layers)


def test_an_output_that_says_more_is_refused():
    model = ModelSpec(
        backbone=CommitteeSpec(members=2, units=4), head=LinearHead(dead_band=True), window=8, output=Quantiles()
    )
    with pytest.raises(ConfigError, match="dead band"):
        check_combination(small_task(model, (3,), TargetMode.DELTA), model)
