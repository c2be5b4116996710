"""What networks compute, seen by tracing: the operations that parts declare and the multiply-accumulates they count."""

from __future__ import annotations

import pytest
import torch

from edp.evaluation.mac_check import Trace, trace
from edp.networks.activations import ACTIVATIONS
from edp.networks.streaming import Operation, Streaming
from edp.testing.operations import check_operations, declaration_errors


def test_parts_declare_exactly_the_operations_they_use(structure, predictor_of):
    check_operations(predictor_of(structure))


def test_a_false_declaration_is_found():
    class False_(torch.nn.Module):
        operations = frozenset({Operation.GELU})

        def forward(self, x):
            return torch.erfinv(torch.tanh(x)) + 1

    module = False_()
    with torch.no_grad(), Trace(module) as seen:
        module(torch.zeros(2))
    assert declaration_errors(module, seen) == [
        ": erfinv has no word in Operation",
        ": tanh is not declared",
        ": gelu is not used",
    ]


@pytest.mark.parametrize("name", list(ACTIVATIONS))
def test_activations_declare_exactly_the_operations_they_use(name):
    module = ACTIVATIONS[name]().build(2).double()
    with torch.no_grad(), Trace(module) as seen:
        module(torch.zeros(3, 2, dtype=torch.float64))
    assert declaration_errors(module, seen) == []


def cost(rows):
    return sum(row.per_column + row.per_prediction + row.pooling for row in rows)


# Parts whose work counts once per prediction; pooling is left out of windowed counts, as in the thesis's tables.
ONCE = ("backbone.extras", "backbone.groups", "backbone.radial", "backbone.near", "gate", "heads", "bypass", "physics")
LEFT_OUT = "backbone.pooling"


def test_the_counted_work_is_what_runs(structure, predictor_of):
    """Part by part for a tick: the first after a reset, the next, and one when every ring is full; and for a window."""
    predictor = predictor_of(structure)
    streams = {name: module for name, module in predictor.named_modules() if isinstance(module, Streaming)}
    window, state = predictor.spec.window, None
    for ticks in (1, 1, window, 1):
        seen, state = trace(predictor, ticks, state)
        if ticks > 1:  # bands of several ticks overlap: more runs than a stream needs
            continue
        for name, module in streams.items():
            assert seen.within(name) == cost(module.costs()), name
        assert not seen.opaque
    kept = {part: macs for part, macs in seen.macs.items() if not part.startswith(LEFT_OUT)}
    once = sum(macs for part, macs in kept.items() if part.startswith(ONCE))
    wanted = sum(window * row.per_column + row.per_prediction for row in predictor.costs())
    assert window * (sum(kept.values()) - once) + once == wanted
