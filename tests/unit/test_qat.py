"""Quantisation-aware training: that it wins back what rounding costs, goes on after a stop, and leaves its grid."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.export import TARGETS
from edp.ir.layers import GroupedDense
from edp.ir.memory import Lstm
from edp.ir.w8a16 import calibrate, quantise
from edp.ir.w8a16.quantise import weights_of
from edp.networks.matrices import matrices_of
from edp.networks.predictor import build_model
from edp.networks.running import stream_predictions
from edp.storage.runs import KeyedRun, Run
from edp.training import fit, load_bundle, make_bundle, save_bundle
from edp.training.bundle import blank_scaler
from edp.training.compression.rounding import Site
from edp.training.validation import validation_scores
from edp.workflows.compression import (
    Distillation,
    DistillationSpec,
    NetworkRounding,
    QuantisationAware,
    RoundingSpec,
    weight_levels,
)

pytestmark = pytest.mark.long

THESIS = Path(__file__).parents[2] / "examples" / "thesis"


@pytest.fixture(scope="module")
def start(tiny, tiny_model, tiny_training):
    return fit(tiny, tiny_model, tiny_training).predictor


@pytest.fixture(scope="module")
def brief(tiny_training):
    return dataclasses.replace(tiny_training, epochs=2, updates=20)


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_the_result_is_an_ordinary_network_on_the_grid(tiny, tiny_model, brief, start, tmp_path):
    fitted = fit(tiny, tiny_model, brief, strategy=QuantisationAware(start, Distillation([start])))
    net = fitted.predictor
    matrices = matrices_of(net)
    assert [matrix.name for matrix in matrices if "recurrent" in matrix.name] == [
        "backbone.recurrent.layers.0.cell.weight_ih_l0",
        "backbone.recurrent.layers.0.cell.weight_hh_l0",
    ]
    for matrix in matrices:
        levels, steps = weight_levels(matrix.values.detach(), matrix.axes)
        torch.testing.assert_close(matrix.values.detach(), levels * steps, rtol=1e-6, atol=0)
        assert levels.abs().max() == 127
    assert not same(net, start)
    save_bundle(make_bundle(net, tiny), tmp_path / "bundle")
    assert same(load_bundle(tmp_path / "bundle").predictor, net)
    TARGETS["c"]().write(load_bundle(tmp_path / "bundle"), "rounded", tmp_path / "c")
    with torch.no_grad():
        once = [value.clone() for value in net.parameters()]
    NetworkRounding(net, 0).keep()
    for value, before in zip(net.parameters(), once, strict=True):
        torch.testing.assert_close(value, before, rtol=1e-6, atol=0)


def test_the_validated_score_is_that_of_the_rounded_network(tiny, tiny_model, brief, start):
    """With weights alone the network that is left computes what was validated."""
    strategy = QuantisationAware(start, spec=RoundingSpec(activation_bits=0))
    fitted = fit(tiny, tiny_model, brief, strategy=strategy)
    best = [row for row in fitted.history if row["best"]]
    score = validation_scores(fitted.predictor, tiny.validation, brief, tiny)[0]
    assert not best or score == pytest.approx(best[-1]["validation_score"], rel=1e-5)


def test_training_rounded_is_better_than_rounding_afterwards(tiny, tiny_model, brief, start):
    """With 8-bit activations rounding costs enough to be seen on so small a problem."""

    def error(net):
        rounding = NetworkRounding(net, 8)
        rounding.install(tiny.train)
        said = stream_predictions(net, tiny.validation)[0]
        rounding.remove()
        truth = tiny.validation[0].targets
        return float(np.abs(said[20:-3, 1] - truth[23:]).mean())

    spec = dataclasses.replace(brief, epochs=3, updates=30)
    strategy = QuantisationAware(start, spec=RoundingSpec(activation_bits=8))
    assert error(fit(tiny, tiny_model, spec, strategy=strategy).predictor) < error(start)


def test_a_stop_changes_nothing(tiny, tiny_model, brief, start, tmp_path):
    def strategy():
        return QuantisationAware(start, Distillation([start]))

    whole = fit(tiny, tiny_model, brief, strategy=strategy())

    class Pulled(Exception):
        pass

    def pull(event):
        if event.row is not None:
            raise Pulled

    with Run(tmp_path / "run") as run:
        with pytest.raises(Pulled):
            fit(tiny, tiny_model, brief, KeyedRun(run, "key"), pull, strategy=strategy())
        resumed = fit(tiny, tiny_model, brief, KeyedRun(run, "key"), strategy=strategy())
    assert resumed.resumed_at == 1
    assert same(whole.predictor, resumed.predictor)


def test_another_network_to_begin_with_is_refused(tiny, tiny_bypass, brief, start):
    with pytest.raises(ConfigError, match="train with its own"):
        fit(tiny, tiny_bypass, brief, strategy=QuantisationAware(start, Distillation([start], DistillationSpec())))


def test_a_site_finds_the_range_that_loses_least():
    values = torch.cat([torch.linspace(-1, 1, 1_000_001), torch.tensor([4.0])])
    for bits, limit in ((16, 16.0), (8, 1.0)):
        site = Site(bits)
        site(values)
        site.compare()
        site(values)
        site.settle()
        assert site.limit == pytest.approx(limit)
    x = torch.tensor([-3.0, 0.3, 3.0], requires_grad=True)
    y = site(x)
    y.sum().backward()
    np.testing.assert_allclose(y.detach(), [-1.0, 0.3, 1.0], atol=0.005)
    assert x.grad.tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(("name", "size"), [("k10_student_u64", "0.1849"), ("k1_student_u64", "0.2834")])
def test_sizes_are_those_of_table_4_9(name, size):
    """The thesis's C_u64_QAT: one byte for each weight but those of the LSTM, four for the others, gains folded."""
    experiment = load_experiment(THESIS / f"{name}.toml")
    task = experiment.task.resolve(100.0)
    net = build_model(task, experiment.model, blank_scaler(task), seed=0)
    rounded = sum(matrix.values.numel() for matrix in matrices_of(net, recurrent=False))
    folded = sum(cost.parameters - cost.foldable for cost in net.costs())
    assert f"{(4 * folded - 3 * rounded) / 1e6:.4f}" == size


def test_whole_numbers_of_a_deployed_network_are_those_that_training_saw(tiny, tiny_model, brief, start):
    """W8A16 of `edp.ir.w8a16`, with weights of least error on data, finds the levels that are there already."""
    net = fit(tiny, tiny_model, brief, strategy=QuantisationAware(start, Distillation([start]))).predictor
    graph = net.graph()
    found = weights_of(quantise(graph, calibrate(graph, [part.inputs for part in tiny.train])))
    assert len(found) == len(matrices_of(net)) == 8
    for layer in graph.layers:
        for name, axes in (("weight", (0, 1) if isinstance(layer, GroupedDense) else (0,)), ("score", ())):
            weight = layer.tensors().get(name)
            if weight is not None and layer.name in found:
                levels, _ = weight_levels(torch.from_numpy(weight), axes)
                np.testing.assert_array_equal(found[layer.name].astype(int), levels.numpy().astype(int))
    (lstm,) = [layer for layer in graph.layers if isinstance(layer, Lstm)]
    for side, weight in (("x", lstm.weight_x), ("h", lstm.weight_h)):
        levels, _ = weight_levels(torch.from_numpy(weight), (0,))
        np.testing.assert_array_equal(found[f"{lstm.name}/{side}"].astype(int), levels.numpy().astype(int))
