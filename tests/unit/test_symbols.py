"""Equations recorded as layers give what they give on tensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edp.errors import ExportError
from edp.ir import Builder
from edp.ir.base import INPUT
from edp.ir.reference import Reference
from edp.networks.physics.symbols import Symbol

KNOWN = torch.tensor([2.0, -3.0, 0.5])
EQUATIONS = {
    "sums": lambda x, y: x + y + KNOWN - 1.0 + (2.0 - x) - (KNOWN - y),
    "products": lambda x, y: x * y * KNOWN * 2.0 - (3.0 * x),
    "quotients": lambda x, y: x / (y.square() + 1.0) + 1.0 / (x * x + 2.0) + x / KNOWN + KNOWN / (y * y + 1.0),
    "functions": lambda x, y: torch.sqrt(x.square() + 1.0) + torch.exp(-y.abs()) + torch.cos(x) - torch.sin(3.0 * y),
    "signs": lambda x, y: torch.sign(x) * torch.maximum(x, -y) + torch.minimum(y, KNOWN) - torch.clamp(x, min=0.3),
    "choices": lambda x, y: ((x < 0.1) & (y > x) | (y > 1.0)).to(x.dtype) * (x < y),
    "columns": lambda x, y: torch.stack((x[..., 2] * y[..., 0], x[..., 0], torch.zeros_like(y[..., 1])), dim=-1),
    "repeats": lambda x, y: (x.unsqueeze(-2) + torch.tensor([[1.0], [2.0]]) * y.unsqueeze(-2))[..., [2, 0]],
    "parts": lambda x, y: x.unbind(-1)[1].unsqueeze(-1) * y,
}


@pytest.mark.parametrize("name", EQUATIONS)
def test_layers_give_what_tensors_give(name):
    equation = EQUATIONS[name]
    build = Builder(6)
    value = Symbol(build, INPUT, (6,))
    made = equation(value[..., [0, 1, 2]], value[..., [3, 4, 5]])
    run = Reference(build.graph({"prediction": build.join("end", made.value)}, 1))
    rows = torch.from_numpy(np.random.default_rng(0).normal(size=(20, 6)))
    wanted = equation(rows[:, :3], rows[:, 3:]).flatten(1).numpy()
    found = np.stack([run.results(row)["prediction"] for row in rows.numpy()])
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)
    assert made.shape == tuple(equation(rows[:, :3], rows[:, 3:]).shape[1:])


def test_a_sum_after_a_product_is_one_layer_and_what_is_known_is_computed_once():
    build = Builder(3)
    x = Symbol(build, INPUT, (3,))
    made = KNOWN * KNOWN - 2.0 * KNOWN * x
    (layer,) = build.graph({"prediction": made.value}, 1).layers
    np.testing.assert_allclose(layer.gain, (-2.0 * KNOWN).numpy())
    np.testing.assert_allclose(layer.shift, KNOWN.square().numpy())


def test_what_has_no_form_is_refused_with_what_has():
    x = Symbol(Builder(3), INPUT, (3,))
    with pytest.raises(ExportError, match=r"torch's erfinv has no form as layers; write the equation with add, sub"):
        torch.erfinv(x)
    with pytest.raises(ExportError, match=r"x\[\.\.\., columns\]"):
        x[0]
