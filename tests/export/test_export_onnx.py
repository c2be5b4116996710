"""The ONNX graphs against PyTorch in ONNX Runtime, for every network that the registries allow, and their rules."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.export.golden import random_inputs, stream, tolerance
from edp.export.onnx.memory import STEPS
from edp.export.onnx.nodes import ALLOWED, OPSETS
from edp.export.onnx.plain import PLAIN
from edp.export.onnx.step import INPUTS, SPOILT, states_of, step_model
from edp.export.onnx.window import rows_needed, window_model
from edp.ir import memory

needed = "needs the packages onnx and onnxruntime: pip install 'excavator-dynamics-predictor[dev]'"
onnx = pytest.importorskip("onnx", reason=needed)
runtime = pytest.importorskip("onnxruntime", reason=needed)

NETWORKS = ("hybrid+all", "hybrid9", "tcn+all", "gru+quantiles", "lstm2", "lstm+hybrid physics")
"""Among them all kinds of layers."""


class StepStream:
    """A stream through a step graph."""

    def __init__(self, session, graph, targets, opset=13):
        self.graph, self.states = graph, states_of(graph)
        self.run = session(step_model(graph, targets, "step", {}, opset))
        self.names = [output.name for output in self.run.get_outputs()]
        self.reset()

    def reset(self):
        self.held = {state.name: state.start for state in self.states}

    def __call__(self, rows):
        found = []
        for row in rows:
            made = dict(zip(self.names, self.run.run(None, {INPUTS: row[None], **self.held})))
            self.held = {state.name: made[state.next] for state in self.states}
            found.append(np.concatenate([made[meaning].ravel() for meaning in self.graph.results]))
        return np.array(found)


@pytest.fixture(scope="session")
def step_of(bundle_of, onnx_session):
    def make(structure, opset=13):
        predictor = bundle_of(structure).predictor
        return predictor, StepStream(onnx_session, predictor.graph(), len(predictor.task.targets), opset)

    return make


def held_to_pytorch(predictor, run, ticks):
    inputs = random_inputs(predictor, ticks, seed=5)
    wanted = stream(predictor, inputs)
    assert np.isfinite(wanted).all()
    return float((np.abs(run(inputs) - wanted) / tolerance(predictor, inputs, wanted)).max())


@pytest.mark.covering
def test_the_step_predicts_what_pytorch_predicts(structure, bundle_of, step_of):
    """Within 1e-5 of a standard deviation and of the largest value."""
    assert held_to_pytorch(*step_of(structure), 60) < 1


def window_differs_by(session, predictor, opset=13, seeds=2):
    graph = predictor.graph()
    run, worst = session(window_model(graph, len(predictor.task.targets), "window", {}, opset)), 0.0
    for seed in range(seeds):
        inputs = random_inputs(predictor, graph.window, seed)
        wanted = stream(predictor, inputs)
        found = np.concatenate([made.ravel() for made in run.run(None, {INPUTS: inputs})])
        worst = max(worst, float((np.abs(found - wanted[-1]) / tolerance(predictor, inputs, wanted)).max()))
    return worst


@pytest.mark.covering
def test_the_window_predicts_what_pytorch_predicts_from_reset(structure, bundle_of, onnx_session):
    assert window_differs_by(onnx_session, bundle_of(structure).predictor) < 1


@pytest.mark.covering
def test_every_value_of_a_graph_is_read(structure, bundle_of):
    """ONNX Runtime up to 1.18 lays what nobody reads over what is still needed, from the second run on."""
    predictor = bundle_of(structure).predictor
    graph, targets = predictor.graph(), len(predictor.task.targets)
    for make in (step_model, window_model):
        made = onnx.load_from_string(make(graph, targets, "graph", {})).graph
        read = {name for node in made.node for name in node.input} | {output.name for output in made.output}
        assert not [name for node in made.node for name in node.output if name and name not in read]


@pytest.mark.parametrize("ticks", [1, 2, 4, 5, 6, 15])
@pytest.mark.parametrize("network", NETWORKS)
def test_windows_of_other_lengths(network, ticks, bundle_of, onnx_session):
    """Shorter than what layers look back, no longer than the first ticks that are corrected, longer than a mean."""
    predictor = bundle_of(network).predictor
    graph = replace(predictor.graph(), window=ticks)
    inputs = random_inputs(predictor, ticks, seed=2)
    wanted = stream(predictor, inputs)
    run = onnx_session(window_model(graph, len(predictor.task.targets), "window", {}))
    found = np.concatenate([made.ravel() for made in run.run(None, {INPUTS: inputs})])
    assert (np.abs(found - wanted[-1]) <= tolerance(predictor, inputs, wanted)).all()


def test_a_window_computes_no_more_rows_than_it_needs(bundle_of):
    graph = bundle_of("tcn").predictor.graph()
    need = rows_needed(graph, 50)
    convolutions = [need[layer.name] for layer in graph.layers if isinstance(layer, memory.Convolution)]
    assert convolutions == sorted(convolutions, reverse=True)
    assert convolutions[-1] == 1
    assert need["input"] < 25
    assert all(need[value] == 1 for value in graph.results.values())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_input_anywhere_in_the_window_shows(bad, bundle_of, onnx_session):
    predictor = bundle_of("tcn+all").predictor
    graph = predictor.graph()
    run = onnx_session(window_model(graph, len(predictor.task.targets), "window", {}))
    inputs = random_inputs(predictor, graph.window, seed=1)
    assert np.isfinite(run.run(None, {INPUTS: inputs})[0]).all()
    for tick in (0, graph.window - 1):
        spoilt = inputs.copy()
        spoilt[tick, 1] = bad
        assert np.isnan(run.run(None, {INPUTS: spoilt})[0]).all()
    with pytest.raises(Exception, match=r"(?i)invalid|unexpected"):
        run.run(None, {INPUTS: inputs[1:]})


@pytest.mark.slow
@pytest.mark.parametrize("network", NETWORKS)
def test_the_step_follows_pytorch_for_a_long_time(network, step_of):
    assert held_to_pytorch(*step_of(network), 20_000) < 1


@pytest.mark.parametrize("opset", OPSETS)
@pytest.mark.parametrize("network", NETWORKS)
def test_every_opset_gives_the_same_numbers(network, opset, step_of, onnx_session):
    assert held_to_pytorch(*step_of(network, opset), 25) < 1
    assert window_differs_by(onnx_session, step_of(network)[0], opset, 1) < 1


@pytest.mark.parametrize("network", ["tcn", "hybrid+all"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_inputs_show_until_the_reset(network, bad, step_of):
    """ReLU swallows a NaN: without a state of its own it would be a wrong number some ticks later."""
    predictor, run = step_of(network)
    inputs = random_inputs(predictor, 60, seed=4)
    fresh = run(inputs)
    spoilt = inputs.copy()
    spoilt[10, 0] = bad
    run.reset()
    found = run(spoilt)
    np.testing.assert_array_equal(found[:10], fresh[:10])
    assert np.isnan(found[10:]).all()
    run.reset()
    np.testing.assert_array_equal(run(inputs), fresh)


def test_two_streams_do_not_know_of_each_other(step_of):
    predictor, run = step_of("hybrid+all")
    a, b = (random_inputs(predictor, 20, seed=seed) for seed in (1, 2))
    alone = run(a)
    run.reset()
    held, found = [run.held, run.held], []
    for pair in zip(a, b):
        for which, row in enumerate(pair):
            run.held = held[which]
            made = run(row[None])
            held[which] = run.held
            if which == 0:
                found.append(made[0])
    np.testing.assert_array_equal(found, alone)


def test_what_does_not_fit_is_refused_by_the_runtime(step_of):
    predictor, run = step_of("hybrid")
    good = random_inputs(predictor, 1, seed=0)
    for bad in (good[:, :-1], np.concatenate([good, good], axis=1), np.repeat(good, 2, axis=0), good.astype(float)):
        with pytest.raises(Exception, match=r"(?i)invalid|unexpected"):
            run.run.run(None, {INPUTS: bad, **run.held})
    first = next(iter(run.held))
    with pytest.raises(Exception, match=r"(?i)required input|missing"):
        run.run.run(None, {INPUTS: good, **{key: value for key, value in run.held.items() if key != first}})


def test_a_layer_has_one_way_to_its_nodes():
    assert not set(PLAIN) & set(STEPS)


def test_names_of_states_are_their_own(bundle_of):
    for network in NETWORKS:
        graph = bundle_of(network).predictor.graph()
        states = states_of(graph)
        names = [name for state in states for name in (state.name, state.next)]
        assert len(set(names)) == len(names)
        assert states[-1].name == SPOILT
        assert sum(state.start.size for state in states) == 1 + sum(slot.size for _, slot in graph.slots())


def test_corrections_reach_the_states_of_other_layers(bundle_of):
    kinds = {type(layer) for network in NETWORKS for layer in bundle_of(network).predictor.graph().layers}
    assert memory.PrefixCorrection in kinds
    assert memory.WindowAttention in kinds


def test_the_page_lists_the_operators(bundle_of):
    page = (Path(__file__).parents[2] / "docs/howto/deploy_onnx.md").read_text()
    listed = page.partition("## Operators")[2].partition("and no others")[0]
    assert set(re.findall(r"[A-Z]\w+", listed)) == ALLOWED
    used = set()
    for network in (*NETWORKS, "lstm+normal", "hybrid", "committee"):
        predictor = bundle_of(network).predictor
        for write in (step_model, window_model):
            model = onnx.load_from_string(write(predictor.graph(), len(predictor.task.targets), "graph", {}))
            kinds = {node.op_type for node in model.graph.node}
            assert write is window_model or not kinds & {"Conv", "GRU", "LSTM", "Transpose"}
            assert all(len(v.type.tensor_type.shape.dim) == 2 for v in (*model.graph.input, *model.graph.output))
            used |= kinds
    assert used == ALLOWED - {"Log"}  # of the tanks of a twin: see test_export_elements.py
