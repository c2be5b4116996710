"""Number formats, orders and the thesis's variants by name."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.evaluation.controller import Budget
from edp.networks.backbones import HybridSpec
from edp.networks.heads import MlpHead
from edp.networks.matrices import matrices_of
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.running import stream_predictions
from edp.training.bundle import blank_scaler
from edp.workflows.compression import (
    FORMATS,
    VARIANTS,
    Bench,
    CompressedCandidate,
    CompressionRequest,
    deploy,
    resource_usage,
    weight_levels,
)
from edp.workflows.compression.bench import tuning

THESIS = Path(__file__).parents[2] / "examples" / "thesis"
WIDE = ModelSpec(backbone=HybridSpec(channels=(64, 8), kernel=2, units=64), head=MlpHead(hidden=16), window=10)


@pytest.fixture(scope="module")
def bench(tiny, tiny_training):
    teacher = build_model(tiny.task, WIDE, tiny.scaler(), seed=0).eval()
    return Bench(teacher, tiny, dataclasses.replace(tiny_training, epochs=1, updates=2))


def test_the_names_are_those_of_the_thesis_and_ours():
    assert list(VARIANTS) == ["A_u32", "A_u64", "B_LPTQ", "C_QAT", "C_u64_QAT", "D_u32", "D_u64"]
    assert {"dynamic_int8", "float32", "w8a16"} <= set(FORMATS)


@pytest.mark.long
@pytest.mark.parametrize("name", list(VARIANTS))
def test_each_variant_is_a_network_that_runs_in_its_format(tiny, bench, name):
    found = VARIANTS[name](bench)
    assert isinstance(found, CompressedCandidate)
    assert found.name == name
    assert found.network.spec == found.order.model(bench.teacher.spec)
    assert found.network.number_format == "float32"
    deployed = deploy(found.network, found.number_format, tiny.train, Budget(), found.parameter_bytes)
    (said,) = deployed.predict(tiny.test)
    (plain,) = stream_predictions(found.network, tiny.test)
    moved = np.abs(plain - tiny.test[0].targets[:, None]).mean()
    assert np.isfinite(said).all()
    assert np.abs(said - plain).mean() < 0.2 * moved
    assert np.array_equal(said, plain) == (found.number_format == "float32")
    if found.order.rounding is not None:
        for matrix in matrices_of(found.network, found.order.rounding.recurrent):
            levels, steps = weight_levels(matrix.values, matrix.axes)
            np.testing.assert_allclose(matrix.values.detach(), (levels * steps).detach(), rtol=1e-6)


def test_what_is_ordered_twice_is_trained_once(bench):
    assert VARIANTS["A_u64"](bench).network is VARIANTS["B_LPTQ"](bench).network


def test_a_rounded_training_is_shorter_and_in_smaller_steps(tiny_training):
    spec = tuning(tiny_training)
    assert spec.epochs == 2
    assert spec.optimizer.learning_rate == pytest.approx(tiny_training.optimizer.learning_rate / 5)


def test_variants_wider_than_the_teacher_are_refused(tiny, tiny_model, tiny_training):
    teacher = build_model(tiny.task, tiny_model, tiny.scaler(), seed=0)
    with pytest.raises(ConfigError, match="units = 32; 1 <= units <= 8"):
        VARIANTS["A_u32"](Bench(teacher, tiny, tiny_training))


@pytest.mark.parametrize(
    ("name", "number_format", "size"),
    [("k10_student_u64", "dynamic_int8", "0.2814"), ("k1_student_u64", "dynamic_int8", "0.6905")],
)
def test_bytes_are_those_of_table_4_9(name, number_format, size):
    experiment = load_experiment(THESIS / f"{name}.toml")
    task = experiment.task.resolve(100.0)
    net = build_model(task, experiment.model, blank_scaler(task), seed=0)
    assert f"{resource_usage(net, number_format, Budget()).parameter_bytes / 1e6:.4f}" == size


def test_what_is_over_budget_is_named(bench):
    found = resource_usage(bench.teacher, "float32", Budget(cycles=1000, parameter_bytes=100))
    assert set(found.over(Budget(cycles=1000, parameter_bytes=100))) == {"cycles", "parameter_bytes"}
    assert resource_usage(bench.teacher, "w8a16", Budget()).over(Budget()) == {}
    orders = CompressionRequest(name="a", units=8), CompressionRequest(name="a", units=8)
    assert orders[0] == orders[1]
