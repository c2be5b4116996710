"""No part can be missed by the counter: what it says is held against the operations that run, part by part."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import nn

from edp.errors import ConfigError
from edp.evaluation.mac_check import Trace, check_counted
from edp.networks.backbones import HybridSpec
from edp.networks.blocks.base import BlockSlot
from edp.networks.cells import CELLS
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.streaming import Cost, Streaming
from edp.testing.streaming import check_work_counted
from edp.training.bundle import blank_scaler
from edp.workflows.compression import dynamic_int8
from edp.workflows.deployment import footprint_of


@pytest.mark.long
def test_every_network_of_the_registries_passes(structure, predictor_of):
    predictor = predictor_of(structure)
    check_work_counted(predictor)
    if predictor.physics is None:
        check_counted(dynamic_int8(predictor).predictor)


def by_matrix(weight, x):
    return nn.functional.linear(x, weight)


def by_sum(weight, x):
    return (weight * x.unsqueeze(-2)).sum(dim=-1)


def by_mean(weight, x):
    return (x[..., None, :] * weight).mean(-1) * weight.shape[1]


def by_columns(weight, x):
    total = weight[:, 0] * x[..., :1]
    for column in range(1, weight.shape[1]):
        total = total + weight[:, column] * x[..., column : column + 1]
    return total


def by_einsum(weight, x):
    return torch.einsum("oi,bti->bto", weight, x)


def by_convolution(weight, x):
    return nn.functional.conv1d(x.transpose(1, 2), weight.unsqueeze(-1)).transpose(1, 2)


WAYS = [by_matrix, by_sum, by_mean, by_columns, by_einsum, by_convolution]


class Custom(Streaming):
    """A recurrence ``h = tanh(W [x ; h])`` whose product and count are chosen."""

    def __init__(self, width_in, units, product, count):
        super().__init__()
        self.units, self.product, self.count = units, product, count
        self.weight = nn.Parameter(torch.randn(units, width_in + units))

    def initial_state(self, batch, like):
        return like.new_zeros(batch, self.units)

    def forward(self, x, state):
        rows = []
        for tick in x.unbind(1):
            state = torch.tanh(self.product(self.weight, torch.cat([tick, state], dim=-1).unsqueeze(1)).squeeze(1))
            rows.append(state)
        return torch.stack(rows, dim=1), state

    def costs(self):
        return [Cost("custom", self.weight.numel(), per_column=self.count(self.weight))]


def complete(weight):
    return weight.numel()


def nothing(weight):
    return 0


def without_recurrence(weight):
    return weight.numel() - len(weight) ** 2


@dataclasses.dataclass(frozen=True)
class CustomCell:
    family: ClassVar[str] = "custom"
    zoneout: ClassVar[bool] = False
    product: object = by_matrix
    count: object = complete

    def build(self, width_in, units, zoneout):
        return Custom(width_in, units, self.product, self.count)


@pytest.fixture
def network(predictor_of, monkeypatch):
    """A hybrid network with a custom recurrent layer, or with any custom part as its by-pass."""
    monkeypatch.setitem(CELLS._parts, "custom", CustomCell)
    task = predictor_of("lstm").task

    def make(cell=None, bypass=None):
        backbone = HybridSpec(channels=(4,), kernel=2, units=5, **({"cell": cell} if cell else {}))
        spec = ModelSpec(backbone=backbone, window=9)
        predictor = build_model(task, spec, blank_scaler(task), seed=0).eval()
        if bypass is not None:
            predictor.bypass = bypass
        return predictor

    return make


@pytest.mark.parametrize("product", WAYS)
def test_a_custom_cell_that_counts_right_passes(product, network):
    check_counted(network(CustomCell(product, complete)))


@pytest.mark.parametrize("product", WAYS)
@pytest.mark.parametrize("count", [nothing, without_recurrence])
def test_a_custom_cell_with_weights_that_are_not_counted_is_found(product, count, network):
    predictor = network(CustomCell(product, count))
    weight = predictor.backbone.recurrent.layers[0].weight
    wanted = rf"'backbone\.recurrent\.layers\.0' .*Custom\) counts {count(weight)} .* but {weight.numel()} run"
    with pytest.raises(ConfigError, match=wanted):
        check_counted(predictor)


class Pooled(Streaming):
    """Products of data with data: every output reads every feature by weights that the features make."""

    slot = BlockSlot.BYPASS

    def __init__(self, fused):
        super().__init__()
        self.fused = fused

    def initial_state(self, batch, like):
        return ()

    def forward(self, x, state):
        rows = x.unsqueeze(-1)
        if self.fused:
            mixed = nn.functional.scaled_dot_product_attention(rows, rows, rows)
        else:
            mixed = torch.softmax(rows @ rows.transpose(-1, -2), dim=-1) @ rows
        return mixed.mean(dim=(-2, -1))[..., None, None], state

    def costs(self):
        return [Cost("pooled", 0)]


def test_products_of_data_are_found_and_fused_operations_are_refused(network):
    with pytest.raises(ConfigError, match=r"'bypass' .*\(Pooled\) counts 0 multiply-accumulates a tick, but 72 run"):
        check_counted(network(bypass=Pooled(fused=False)))
    with pytest.raises(ConfigError, match=r"'bypass' .* computes .*scaled_dot_product.* nobody knows"):
        check_counted(network(bypass=Pooled(fused=True)))


def test_element_wise_work_is_no_product():
    gate, shift = nn.Parameter(torch.ones(3, 4)), nn.Parameter(torch.ones(3, 4))
    with torch.no_grad(), Trace(nn.ParameterList([gate, shift])) as seen:
        x = torch.ones(1, 1, 4)
        seen.read(x)
        torch.sigmoid(gate * x + shift) * x
    assert seen.within("") == 0
    assert not seen.opaque


def test_the_command_refuses_a_network_that_is_counted_wrongly(monkeypatch):
    settings = Path(__file__).parents[2] / "examples/thesis/k10_student_u32.toml"
    layer = type(HybridSpec().cell.build(2, 2, 0.0))
    # What the thesis's profiler did.
    monkeypatch.setattr(layer, "costs", lambda self: [Cost("recurrent", 0)])
    with pytest.raises(ConfigError, match=r"counts 0 .* but 8,192 run: correct its method `costs`"):
        footprint_of(settings)
