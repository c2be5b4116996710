"""The format of a network's inputs in integers: what clips rare values may cost less than what is coarse."""

from dataclasses import replace

import numpy as np
import pytest

from edp.errors import ExportError
from edp.ir import Builder, Graph
from edp.ir.base import INPUT
from edp.ir.layers import BinaryOperation, Dense, Standardise
from edp.ir.w8a16 import Formats, Integers, calibrate, quantise
from edp.ir.w8a16.calibration import finer
from edp.ir.w8a16.quantise import outline
from edp.networks.integer import integer_predictor, spread
from edp.networks.running import mean_error, stream_predictions
from edp.training import fit

SCALED = "front.scaled"


@pytest.fixture(scope="module")
def network(tiny, tiny_model, tiny_training):
    return fit(tiny, tiny_model, tiny_training).predictor


def with_spike(series, size, at=100):
    """The first series with one tick in which every input is `size` times its own."""
    inputs = series[0].inputs.copy()
    inputs[at] *= size
    return [replace(series[0], inputs=inputs), *series[1:]]


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [([4, 3, 2, 3, 3, 1], 10), ([1, 1, 0, 1, 1], 10), ([3, 2, 1, 1, 0.5, 2, 2], 12), ([float("nan")] * 3, 8)],
)
def test_the_format_becomes_finer_while_the_error_falls(errors, chosen):
    assert finer(8, lambda frac: errors[frac - 8]) == chosen


@pytest.mark.long
def test_one_wild_tick_does_not_make_all_inputs_coarse(network, tiny):
    known = with_spike(tiny.train, 3000.0)
    plain = calibrate(network.graph(), [part.inputs for part in known]).fracs[SCALED]
    usual = integer_predictor(network, tiny.train).formats.fracs[SCALED]
    assert plain <= usual - 8
    chosen = integer_predictor(network, known)
    assert chosen.formats.fracs[SCALED] > plain
    coarse = type(chosen)(network, calibrate(network.graph(), [part.inputs for part in known]))
    wanted = stream_predictions(network, tiny.validation)

    def away(one):
        found = stream_predictions(one, tiny.validation)
        return np.mean([np.abs(a - b).mean() for a, b in zip(found, wanted, strict=True)])

    assert away(chosen) < away(coarse)


def test_the_error_is_that_of_a_loop_over_ticks(network, tiny):
    skip, each = network.spec.window, []
    for part, predicted in zip(tiny.validation, stream_predictions(network, tiny.validation), strict=True):
        for place, k in enumerate(tiny.task.horizons):
            ticks = range(skip, part.samples - k)
            each.append(np.mean([abs(predicted[t, place] - part.targets[t + k]) for t in ticks], axis=0))
    assert mean_error(network, tiny.validation) == pytest.approx(np.mean(each), rel=1e-5)
    short = [replace(tiny.validation[0], inputs=part.inputs[:skip], targets=part.targets[:skip])]
    assert np.isnan(mean_error(network, short))


def test_series_are_taken_at_even_distances(tiny):
    total = sum(part.samples for part in tiny.train)
    assert spread(tiny.train, total) == tiny.train
    assert spread(tiny.train, 1) == tiny.train[:1]


def test_an_operation_without_an_integer_form_is_refused_by_its_word():
    """A quotient between the scaled inputs and weights; those of the physics bases lie behind the last weights."""
    build, ones = Builder(2), np.ones(2)
    scaled = build.add(Standardise, "scaled", INPUT, offset=0 * ones, scale=ones)
    quotient = build.combine("quotient", BinaryOperation.DIVIDE, scaled, scaled)
    result = build.add(Dense, "result", quotient, weight=ones[None], bias=ones[:1])
    with pytest.raises(ExportError, match="layer 'quotient' is a Divide, which has no form in integer arithmetic"):
        outline(build.graph({"prediction": result}, 1))


def wide_layer(count, seed=0):
    """A dense layer of one row of `count` large weights, one of small ones that fit, and a graph around it."""
    draw = np.random.default_rng(seed)
    weight = np.stack([draw.choice([-1.0, 1.0], count), np.where(np.arange(count) < 4, 1.0, 1e-3)]).astype(np.float32)
    ones, none = np.ones(count, np.float32), np.zeros(count, np.float32)
    scaled = Standardise(name="scaled", inputs=("input",), offset=none, scale=ones)
    dense = Dense(name="dense", inputs=("scaled",), weight=weight, bias=np.float32([0.5, 0.5]))
    return Graph(count, (scaled, dense), {"prediction": "dense"})


def test_rows_that_could_leave_32_bits_take_coarser_weights_and_others_keep_theirs():
    graph = wide_layer(1500)
    integers = quantise(graph, Formats({"scaled": 10, "dense": 5}))
    layer = integers.layer("dense")
    sums = np.abs(layer.weight.astype(np.int64)).sum(axis=1) * 32767 + np.abs(layer.bias)
    assert 0.9 * 2**31 < sums[0] < 2**31
    assert np.abs(layer.weight[0]).max() < 127
    assert np.abs(layer.weight[1]).max() == 127
    rows = np.random.default_rng(1).normal(size=(50, 1500)).astype(np.float32)
    found = Integers(integers).run(rows[:, None])["prediction"][:, 0]
    wanted = rows @ graph.layer("dense").weight.T + 0.5
    # Equal weights are whole multiples of any scale: what is left is the format of the result, and of the inputs.
    np.testing.assert_allclose(found[:, 0], wanted[:, 0], rtol=0.015, atol=2 * 2.0**-5)


def test_rows_that_two_bits_do_not_save_are_refused():
    with pytest.raises(ExportError, match=r"a sum of 6000 products may reach .*; \d+ inputs of this size would fit"):
        quantise(wide_layer(6000), Formats({"scaled": 10, "dense": 5}))
