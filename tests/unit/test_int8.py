"""Dynamic INT8 of linear layers: what is rounded, what it costs, and that it is never lost on the way to a score."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edp.config.experiment import load_experiment
from edp.errors import BundleError, ExportError
from edp.networks.backbones import HybridSpec
from edp.networks.blocks import CrossCylinderAttention
from edp.networks.heads import GluHead
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.running import stream_predictions
from edp.networks.stream import Stream
from edp.training.bundle import blank_scaler, make_bundle, save_bundle
from edp.training.compression.int8 import round_tick
from edp.workflows.compression import dynamic_int8

THESIS = Path(__file__).parents[2] / "examples" / "thesis"
MODEL = ModelSpec(
    backbone=HybridSpec(channels=(8, 6), kernel=3, units=8),
    head=GluHead(hidden=8, layers=2),
    blocks=(CrossCylinderAttention(),),
    window=10,
)


@pytest.fixture(scope="module")
def network(tiny):
    return build_model(tiny.task, MODEL, tiny.scaler(), seed=0).eval()


def test_predictions_change_a_little_and_the_network_itself_does_not(tiny, network):
    before = {name: value.clone() for name, value in network.state_dict().items()}
    plain = stream_predictions(network, tiny.test)[0]
    rounded = stream_predictions(dynamic_int8(network).predictor, tiny.test)[0]
    moved = np.abs(plain - tiny.test[0].targets[:, None]).mean()
    assert 0 < np.abs(rounded - plain).mean() < 0.05 * moved
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    np.testing.assert_array_equal(stream_predictions(network, tiny.test)[0], plain)


def test_a_stream_sees_the_numbers_of_a_chunk(tiny, network):
    """Rounding is of each tick by itself; a value at the edge of two levels may fall either way for a last bit."""
    quantised = dynamic_int8(network).predictor
    whole = stream_predictions(quantised, tiny.test)[0][:60]
    stream = Stream(quantised)
    ticks = np.stack([stream.step(row).prediction for row in tiny.test[0].inputs[:60]])
    assert np.median(np.abs(ticks - whole)) < 1e-6 * np.abs(whole).max()


def test_every_weight_of_a_linear_layer_lies_on_its_grid_and_the_others_are_as_they_were(network):
    quantised = dynamic_int8(network)
    for weight, scaled in zip(network.heads.weights, quantised.predictor.heads.weights, strict=True):
        steps = weight.abs().amax(dim=1, keepdim=True) / 127
        levels = (scaled / steps).round()
        torch.testing.assert_close(levels * steps, scaled.detach(), atol=1e-7, rtol=1e-5)
        assert levels.abs().max() == 127
        assert ((scaled - weight).abs() <= 0.5001 * steps).all()
    for name in ("backbone.encoder.levels.0.shortcut.weight", "backbone.recurrent.layers.0.cell.weight_hh_l0"):
        assert torch.equal(network.state_dict()[name], quantised.predictor.state_dict()[name])
    assert "backbone.pooling.score" in quantised.largest_error
    assert max(quantised.largest_error.values()) > 0


def test_rounded_ticks_have_zero_and_both_ends():
    x = torch.tensor([[-1.0, 0.0, 0.3, 2.0], [0.5, 1.0, 0.7, 0.0], [0.0, 0.0, 0.0, 0.0]])
    y = round_tick(x)
    step = (x.amax(dim=-1).clamp(min=0) - x.amin(dim=-1).clamp(max=0)) / 255
    assert ((y - x).abs() <= 1.01 * step[:, None]).all()
    assert y[0, 1] == 0
    assert torch.equal(y[2], x[2])
    many = torch.randn(1, 5000, generator=torch.Generator().manual_seed(0))
    assert len(round_tick(many).unique()) <= 256


@pytest.mark.parametrize(("name", "size"), [("k10_student_u64", "0.2814"), ("k1_student_u64", "0.6905")])
def test_sizes_are_those_of_table_4_9(name, size):
    experiment = load_experiment(THESIS / f"{name}.toml")
    task = experiment.task.resolve(100.0)
    net = build_model(task, experiment.model, blank_scaler(task), seed=0)
    assert f"{dynamic_int8(net).weight_bytes / 1e6:.4f}" == size


def test_a_quantised_network_is_not_saved_as_if_it_were_not(tiny, network, tmp_path):
    with pytest.raises(BundleError, match="dynamic int8"):
        save_bundle(make_bundle(dynamic_int8(network).predictor, tiny), tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
    with pytest.raises(ExportError, match="dynamic int8 has no list of float32 layers"):
        dynamic_int8(network).predictor.graph()
