"""Every network that the registries allow, as a list of streaming layers that means the same."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from edp.errors import ExportError
from edp.export.golden import random_inputs
from edp.ir import base
from edp.ir.reference import Reference
from edp.testing.streaming import check_graph, check_graph_costs
from edp.training.bundle import blank_scaler


def test_the_list_means_what_the_network_computes(structure, predictor_of):
    # The float32 weights that a graph holds.
    check_graph(predictor_of(structure).float().double())


def test_the_list_counts_what_the_network_counts(structure, predictor_of):
    check_graph_costs(predictor_of(structure))


def test_names_are_unique_and_values_are_made_before_they_are_read(structure, predictor_of):
    predictor = predictor_of(structure)
    graph = predictor.graph()
    made = {base.INPUT: graph.inputs}
    for layer in graph.layers:
        assert layer.name not in made
        assert layer.name == layer.name.lower()
        assert all(name in made for name in layer.inputs)
        made[layer.name] = layer.width
    assert set(graph.results.values()) <= set(made)
    for _, name, values in graph.tensors():
        assert np.isfinite(values).all()
        assert values.dtype == (np.uint16 if name == "feature" else np.float32)


def met(graph):
    """Kinds of layers with their options, and which kind reads which."""
    kinds = {layer.name: layer.kind for layer in graph.layers}
    found = set()
    for layer in graph.layers:
        values = ((field.name, getattr(layer, field.name)) for field in fields(layer) if field.name != "name")
        found.add((layer.kind, *((name, value) for name, value in values if isinstance(value, str | bool))))
        found |= {(layer.kind, kinds.get(name)) for name in layer.inputs}
    return found


@pytest.mark.long
def test_a_covering_set_meets_every_layer_and_every_pair_of_layers(parts, covering, predictor_of):
    seen = {structure: met(predictor_of(structure).graph()) for structure in parts[0]}
    assert set().union(*(seen[structure] for structure in covering)) == set().union(*seen.values())
    assert len(covering) < len(parts[0]) / 2


def test_weights_that_are_not_finite_are_refused(predictor_of):
    predictor = predictor_of("lstm")
    broken = type(predictor)(predictor.task, predictor.spec, blank_scaler(predictor.task))
    with torch.no_grad():
        next(iter(broken.heads.weights))[0, 0, 0] = torch.nan
    with pytest.raises(ExportError, match="NaN or infinite"):
        broken.graph()


@pytest.mark.covering
def test_many_ticks_at_once_are_the_same_ticks_one_by_one(structure, predictor_of):
    predictor = predictor_of(structure)
    rows = random_inputs(predictor, 20, seed=3).astype(float)
    run = Reference(predictor.graph())
    one_by_one = [run.step(row) for row in rows]
    run.reset()
    parts = [run.values(part[:, None]) for part in np.split(rows, [1, 8])]
    for name in one_by_one[0]:
        together = np.concatenate([part[name] for part in parts])[:, 0]
        expected = np.array([values[name] for values in one_by_one])
        np.testing.assert_allclose(together, expected, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(expected).max(initial=0)))
