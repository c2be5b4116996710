"""Every network that the registries allow, in integers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.data.series import Series
from edp.errors import ExportError
from edp.ir.kinds import FLOAT_KINDS
from edp.ir.reference import Reference
from edp.ir.w8a16 import Integers, calibrate, quantise
from edp.ir.w8a16.quantise import LOWER
from edp.networks.integer import IntegerPredictor
from edp.networks.running import stream_intervals, stream_predictions


def series_of(rows, predictor):
    return Series("s", rows, np.zeros((len(rows), len(predictor.task.targets)), dtype=np.float32))


@pytest.fixture
def network(structure, predictor_of, integers_of):
    """A float network and its integer form."""
    return predictor_of(structure, dtype=torch.float32), integers_of(structure)


def test_networks_without_a_form_are_refused_by_name(structure, predictor_of, rows_of):
    predictor = predictor_of(structure, dtype=torch.float32)
    graph = predictor.graph()
    if any("integers" in layer.without for layer in graph.layers):
        with pytest.raises(ExportError, match="no form in integer arithmetic; train with"):
            calibrate(graph, [rows_of(predictor, 5)])
    else:
        calibrate(graph, [rows_of(predictor, 5)])


@pytest.mark.long
@pytest.mark.covering
def test_integers_predict_nearly_the_same(network, rows_of):
    predictor, integers = network
    rows = [series_of(rows_of(predictor, seed=seed), predictor) for seed in (1, 2)]
    wanted, found = (np.stack(stream_predictions(each, rows)) for each in (predictor, integers))
    spread = predictor.code.width.numpy() * np.ones_like(wanted[0])
    error = np.sqrt(np.mean(((found - wanted) / spread) ** 2))
    assert error < 0.05 * max(1.0, float(np.std(wanted / spread)))
    if predictor.output.coverages:
        bounds = np.stack(stream_intervals(integers, rows))
        assert (bounds[:, :, :, 0] <= bounds[:, :, :, 1]).all()


def on_grid(graph):
    """The graph with weights that are multiples of 1/127 of their output's largest one."""
    held = []
    for layer in graph.layers:
        changed = {}
        for name, values in layer.tensors().items():
            if name in ("weight", "weight_x", "weight_h", "score"):
                outputs = layer.bias.ndim if name == "weight" else values.ndim - 1
                step = np.abs(values).max(axis=tuple(range(outputs, values.ndim)), keepdims=True) / 127
                changed[name] = (np.rint(values / np.maximum(step, 1e-30)) * step).astype(np.float32)
        held.append(replace(layer, **changed))
    return replace(graph, layers=tuple(held))


@pytest.mark.covering
def test_sixteen_bit_values_lose_next_to_nothing(network, rows_of):
    """Against double precision with weights that are integers already: what is left is formats and tables."""
    predictor, _ = network
    if predictor.physics is not None:
        pytest.skip("the equations stay in single precision, which poses of random inputs strain")
    graph, rows = on_grid(predictor.graph()), rows_of(predictor)
    exact = Reference(graph)
    wanted = np.stack([exact.results(row)["prediction"] for row in rows])
    found = Integers(quantise(graph, calibrate(graph, [rows]))).run(rows[:, None])["prediction"][:, 0]
    spread = np.tile(predictor.code.width.numpy().ravel(), wanted.shape[1] // predictor.code.width.numel())
    error = np.sqrt(np.mean(((found - wanted) / spread) ** 2))
    assert error < 0.003 * max(1.0, float(np.std(wanted / spread)))


@pytest.mark.covering
def test_chunks_and_company_change_no_bit(network, rows_of):
    predictor, integers = network
    rows = torch.from_numpy(np.stack([rows_of(predictor, 90, seed) for seed in (3, 4)]))
    whole, _ = integers.predict(rows, integers.initial_state(2, rows))
    state, parts = integers.initial_state(1, rows), []
    for start, stop in ((0, 1), (1, 37), (37, 90)):
        part, state = integers.predict(rows[1:, start:stop], state)
        parts.append(part)
    torch.testing.assert_close(torch.cat(parts, dim=1)[0], whole[1], rtol=0, atol=0)


@pytest.mark.covering
def test_weights_and_formats_are_all_that_is_needed(network):
    predictor, integers = network
    again = IntegerPredictor(predictor, integers.formats)
    for (layer, name, values), (_, _, other) in zip(integers.integers.tensors(), again.integers.tensors(), strict=True):
        np.testing.assert_array_equal(values, other, err_msg=f"{layer} {name}")
        assert values.dtype == other.dtype


@pytest.mark.covering
def test_no_weight_stays_real(network):
    _, integers = network
    for layer in integers.integers.layers:
        weighted = [values.dtype for name, values in layer.tensors().items() if "weight" in name or name == "score"]
        assert set(weighted) <= {np.dtype(np.int8)}, layer.name
        assert layer.macs == 0 or weighted or layer.stays_float, layer.name


def test_every_kind_of_layer_is_known():
    floats = {kind for kind in FLOAT_KINDS if kind.bit_exact or kind.stays_float}
    assert {*LOWER, *floats, *(kind for kind in FLOAT_KINDS if "integers" in kind.without)} == FLOAT_KINDS


def test_inputs_beyond_their_range_are_clipped_and_counted(predictor_of, rows_of):
    predictor = predictor_of("lstm", dtype=torch.float32)
    integers = IntegerPredictor(predictor, calibrate(predictor.graph(), [rows_of(predictor)]))
    run = integers.initial_state(1, torch.zeros(1))
    run.run(rows_of(predictor)[:, None])
    assert run.clipped == 0
    run.run(1e6 * np.ones((3, 1, predictor.front.inputs), dtype=np.float32))
    assert run.clipped >= 3
    run.reset()
    assert run.clipped == 0


def test_formats_of_another_network_are_refused(predictor_of, rows_of):
    first, second = (predictor_of(name, dtype=torch.float32) for name in ("lstm", "tcn"))
    chosen = calibrate(first.graph(), [rows_of(first)])
    with pytest.raises(ExportError, match="the formats are those of another network"):
        quantise(second.graph(), chosen)
