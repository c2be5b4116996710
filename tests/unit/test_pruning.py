"""Structured pruning: what is kept, and that nothing else is changed."""

import dataclasses

import pytest
import torch

from edp.errors import ConfigError, DataError
from edp.networks.backbones import GruSpec, HybridSpec, LstmSpec, TcnSpec
from edp.networks.blocks import BLOCKS, CylinderGate, MultiScaleTcn, TemporalDifference
from edp.networks.cells import CELLS, MinGruCell, Stack
from edp.networks.convolution import CausalConv, TemporalBlock
from edp.networks.heads import GluHead, MlpHead
from edp.networks.initial import ConstantState
from edp.networks.narrow import student
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.running import stream_predictions
from edp.training.compression.taylor import _loss
from edp.workflows.compression import importance, prune

HYBRID = HybridSpec(channels=(8, 8, 6), kernel=3, units=8, layers=2)
NETWORKS = {
    "lstm": ModelSpec(backbone=LstmSpec(units=8, zoneout=0.2), head=MlpHead(hidden=8, layers=2), window=10),
    "gru": ModelSpec(backbone=GruSpec(units=8), head=GluHead(hidden=8), window=10),
    "tcn": ModelSpec(backbone=TcnSpec(channels=(8, 8, 8), kernel=3), head=MlpHead(hidden=8), window=10),
    "hybrid": ModelSpec(
        backbone=HYBRID,
        head=GluHead(hidden=8, layers=2),
        blocks=(MultiScaleTcn(), TemporalDifference(), CylinderGate()),
        window=10,
    ),
    "minimal": ModelSpec(
        backbone=dataclasses.replace(HYBRID, layers=1, cell=MinGruCell()), head=MlpHead(hidden=8), window=10
    ),
}


def built(data, model, seed=0):
    return build_model(data.task, model, data.scaler(), seed=seed).eval()


def narrower(model, units):
    channels = getattr(model.backbone, "channels", None)
    return student(model, units, levels=len(channels) if channels else None)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_pruned_to_its_own_widths_is_itself(tiny, name):
    net = built(tiny, NETWORKS[name])
    same = prune(net, NETWORKS[name], tiny.train[:1])
    one, other = (stream_predictions(part, tiny.test)[0] for part in (net, same))
    torch.testing.assert_close(torch.from_numpy(one), torch.from_numpy(other), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
def test_features_without_effect_go_and_the_predictions_stay(tiny, name):
    """Half of everything is cut off from the output: the pruned network predicts what the full one did."""
    model = NETWORKS[name]
    net = built(tiny, model)
    with torch.no_grad():
        silence(net)
    pruned = prune(net, narrower(model, 4), tiny.train[:1])
    one, other = (stream_predictions(part, tiny.test)[0] for part in (net, pruned))
    torch.testing.assert_close(torch.from_numpy(one), torch.from_numpy(other), atol=1e-6, rtol=1e-4)
    assert sum(p.numel() for p in pruned.parameters()) < 0.6 * sum(p.numel() for p in net.parameters())


def silence(net):
    """Odd channels, units and hidden features are made constant zero, and nothing is silent among the even ones."""
    for part in net.modules():
        if isinstance(part, CausalConv):
            part.gain[1::2] = 0.0
            part.bias[1::2] = 0.0
        elif isinstance(part, TemporalBlock) and part.shortcut is not None:
            part.shortcut.weight[1::2] = 0.0
            part.shortcut.bias[1::2] = 0.0
        elif isinstance(part, Stack):
            for layer in part.layers:
                for parameter in layer.parameters():
                    units = layer.cell.hidden_size if hasattr(layer, "cell") else layer.units
                    rows = parameter.view(-1, units, *parameter.shape[1:])
                    # The candidate of a silent unit is zero, so its state stays at zero; its gates do not matter.
                    rows[2 if rows.shape[0] == 4 else -1, 1::2] = 0.0
    heads = net.heads
    for weight, bias, unit in zip(heads.weights[:-1], heads.biases[:-1], heads.units, strict=True):
        weight[..., 1 : weight.shape[-1] // unit.factor : 2] = 0.0
        bias[..., 1 : bias.shape[-1] // unit.factor : 2] = 0.0


def test_importance_is_the_squared_change_of_the_loss(tiny):
    """Held to finite differences: the loss with a hidden feature of a head scaled by 1 +- epsilon."""
    net = built(tiny, NETWORKS["lstm"]).double()
    part = dataclasses.replace(tiny.train[0], inputs=tiny.train[0].inputs[:150], targets=tiny.train[0].targets[:150])
    found = importance(net, [part])
    assert {tuple(worth.shape) for worth in found.hidden} == {(3, 8)}

    def loss():
        with torch.no_grad():
            return float(_loss(net, part, 0, part.samples - 3))

    last, epsilon = net.heads.weights[-1], 1e-4
    with torch.no_grad():
        for output, feature in ((0, 2), (2, 5)):
            whole = last[output, feature].clone()
            last[output, feature] = whole * (1 + epsilon)
            above = loss()
            last[output, feature] = whole * (1 - epsilon)
            below = loss()
            last[output, feature] = whole
            slope = (above - below) / (2 * epsilon)
            assert float(found.hidden[1][output, feature]) == pytest.approx(slope**2, rel=1e-3, abs=1e-14)


def test_measuring_leaves_the_network_as_it_was(tiny):
    net = built(tiny, NETWORKS["hybrid"]).train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    importance(net, tiny.train[:1])
    assert net.training
    assert all(parameter.grad is None for parameter in net.parameters())
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_a_path_without_weights_keeps_its_channels_and_one_that_needs_weights_gets_them(tiny):
    model = NETWORKS["tcn"]
    uneven = dataclasses.replace(model, backbone=dataclasses.replace(model.backbone, channels=(8, 5, 5)))
    net = built(tiny, model)
    pruned = prune(net, uneven, tiny.train[:1])
    kept = pruned.backbone.levels[1].shortcut.weight
    assert pruned.backbone.levels[2].shortcut is None
    assert kept.sum(dim=1).tolist() == [1.0] * 5
    assert set(kept.flatten().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("big", "small", "message"),
    [
        (
            ModelSpec(
                backbone=HybridSpec(channels=(8,), units=8, cell=CELLS["diagonal_ssm"](), initial=ConstantState())
            ),
            None,
            r"no rule for a recurrent layer 'diagonal_ssm' .*; the initial state 'constant'",
        ),
        (
            ModelSpec(backbone=LstmSpec(units=8), blocks=(BLOCKS["global_average_pooling"](),)),
            None,
            "the block 'global_",
        ),
        (NETWORKS["lstm"], NETWORKS["gru"], "another backbone"),
        (NETWORKS["tcn"], dataclasses.replace(NETWORKS["tcn"], window=9), "differ in more than widths"),
        (
            NETWORKS["tcn"],
            dataclasses.replace(NETWORKS["tcn"], backbone=TcnSpec(channels=(8, 9, 8), kernel=3)),
            r"channels = \(8, 9, 8\) is not narrower than \(8, 8, 8\)",
        ),
    ],
)
def test_what_cannot_be_pruned_is_refused(tiny, big, small, message):
    with pytest.raises(ConfigError, match=message):
        prune(built(tiny, big), small or big, tiny.train)


def test_series_without_a_target_are_refused(tiny):
    part = dataclasses.replace(tiny.train[0], inputs=tiny.train[0].inputs[:3], targets=tiny.train[0].targets[:3])
    with pytest.raises(DataError, match="no series is longer than the horizon of 3 ticks"):
        importance(built(tiny, NETWORKS["lstm"]), [part])
