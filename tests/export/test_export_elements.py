"""Elements in exported forms: tanks, of which one is not measured, masses and lags; the logarithm that they need."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ExportError
from edp.export import make_target
from edp.export.golden import grown_tolerance, random_inputs, stream
from edp.export.onnx.nodes import ALLOWED
from edp.export.onnx.step import step_model
from edp.ir import Builder
from edp.ir.arithmetic import EXACT, RUNTIME
from edp.ir.base import INPUT
from edp.ir.layers import LEAST, Activate, Function
from edp.ir.memory import Feedback
from edp.ir.reference import Reference
from edp.networks.twin import fit_scales
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.lumped.parts import LagElement, MassElement, TankElement
from edp.signals import Channel, Kind
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.deployment import quantise_twin

DRIVER = Path(__file__).with_name("tangent_driver.c")
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SPEC = ElementsBox(
    tanks=(
        TankElement(name="upper", source="pump"),
        TankElement(name="lower", source="upper", level="level"),
        TankElement(name="third", source="lower", level="third_level"),
    ),
    masses=(MassElement(name="axis", command="drive", velocity="speed"),),
    lags=(LagElement(name="line", command="drive", pressure="line_pressure"),),
)


@pytest.fixture(scope="module")
def bundle():
    """Three tanks in a row behind a pump, the first not measured, beside an axis with a pressure; plausible numbers."""
    channels = TwinChannels(
        (Channel("pump", Kind.RATIO), Channel("drive", Kind.RATIO)),
        tuple(Channel(name, Kind.VELOCITY) for name in ("rise", "speed", "third_rise")),
        tuple(Channel(name, Kind.POSITION) for name in ("level", "place", "third_level")),
        (Channel("line_pressure", Kind.PRESSURE),),
        4.0,
    )
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform([0.0, -1.0], [4.0, 1.0], (40, 2)), 20, axis=0)
    low, high = np.array([-0.1, -0.5, -0.1, 0, 0, 0, 1e5]), np.array([0.1, 0.5, 0.1, 1, 2, 1, 3e6])
    series = Series("runs", commands.astype(np.float32), rng.uniform(low, high, (800, 7)).astype(np.float32))
    twin = SPEC.start(channels, fit_scales(channels, [series]), [series], 0)
    twin.numbers[twin.places["line", "gain"]] = 4e5
    return plant_bundle(TwinBundle(SPEC, twin))


def built(c, bundle, folder, program, *flags, tangent=False):
    c.need("gcc")
    make_target("c", {"tangent": tangent}).write(bundle, "predictor", folder)
    own = [*c.sources(folder), *(["predictor_tangent.c"] if tangent else []), program]
    c.run("gcc", *c.flags, *flags, "-I", folder, *dict.fromkeys(own), "-lm", "-o", "program", folder=folder)
    return folder / "program"


@pytest.mark.parametrize("mixed", [True, False], ids=["mixed", "free"])
def test_layers_and_c_answer_what_the_twin_answers(c, bundle, mixed, tmp_path):
    plant = bundle.predictor
    rows = random_inputs(plant, 600, seed=6, mixed=mixed)
    rows[:, : plant.required] *= 2.0
    expected = stream(plant, rows)
    allowed = grown_tolerance(plant, rows, expected)
    assert (np.abs(stream(copy.deepcopy(plant).double(), rows) - expected) <= allowed).all()
    strokes = expected[:, 3:6]
    assert (strokes == plant.twin.scales.high[3:6]).any(axis=0).all()  # bounds and overflow act
    program = built(c, bundle, tmp_path, "host_test.c", "-O1")
    assert (np.abs(c.stream(program, rows) - expected) <= allowed).all()
    assert b"all tests passed" in c.run(program)


def test_a_level_that_is_not_measured_starts_where_the_twin_s_does(bundle):
    graph, twin = bundle.predictor.graph(), bundle.predictor.twin
    hidden = next(layer for layer in graph.layers if isinstance(layer, Feedback) and layer.name.endswith("hidden"))
    assert graph.start(hidden.name, hidden.slots[0]) == pytest.approx(twin.starting_levels(twin.numbers))
    plant = bundle.predictor
    rows = random_inputs(plant, 40, seed=1, mixed=False)
    fuller = copy.deepcopy(plant)
    fuller.twin.numbers[fuller.twin.places["upper", "start"]] *= 1.2
    assert not np.array_equal(stream(copy.deepcopy(plant).double(), rows), stream(fuller.double(), rows))


def test_tangents_are_differences(c, bundle, tmp_path):
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, DRIVER, "-O0", tangent=True)
    rows = random_inputs(plant, 40, seed=7, mixed=False)
    changes = np.zeros_like(rows)
    changes[:, : plant.required] = np.random.default_rng(1).normal(size=(40, plant.required))
    feed = np.stack([rows, changes], axis=1).astype(np.float32)
    slopes = np.frombuffer(c.run(program, 1, feed=feed.tobytes()), np.float32).reshape(len(rows), 2, -1)[:, 1]
    ends = [answers(plant, rows + side * 1e-6 * changes.astype(np.float64)) for side in (1.0, -1.0)]
    wanted = (ends[0] - ends[1]) / 2e-6
    largest = np.abs(wanted).max(axis=0)
    assert largest.min() > 0.0
    # Where a bound acts on one side only, the difference is no derivative.
    assert (np.abs(slopes - wanted) / largest > 1e-3).any(axis=1).mean() < 0.1


def answers(plant, rows):
    run = Reference(plant.graph())
    return np.array([run.results(row)["prediction"] for row in rows])


def test_sanitisers_and_the_fuzzer_find_nothing(c, bundle, tmp_path):
    built(c, bundle, tmp_path, "fuzz.c", "-DREPLAY", *SANITISED)
    (tmp_path / "bytes").write_bytes(np.random.default_rng(0).bytes(4000))
    assert b"every rule held" in c.run(tmp_path / "program", tmp_path / "bytes")


def test_an_onnx_graph_has_the_logarithm(bundle):
    onnx = pytest.importorskip("onnx")
    graph = onnx.load_from_string(step_model(bundle.predictor.graph(), 7, "graph", {})).graph
    kinds = {node.op_type for node in graph.node}
    assert "Log" in kinds
    assert kinds <= ALLOWED


def test_eight_bits_are_refused_where_there_are_no_weights(bundle):
    class Nothing:
        def read(self):
            return []

    with pytest.raises(ExportError, match=r"no matrix of weights.*export in float32"):
        quantise_twin(bundle, Nothing())


def test_the_logarithm_of_single_precision_is_the_logarithm():
    rng = np.random.default_rng(0)
    x = np.exp(rng.uniform(-87.0, 88.0, 20_000)).astype(np.float32)
    near = (1.0 + rng.uniform(-0.4, 0.5, 20_000)).astype(np.float32)
    for values in (x, near):
        exact = np.log(values.astype(np.float64))
        assert RUNTIME.apply(Function.LOG, values) == pytest.approx(exact, rel=4e-7, abs=1e-12)
    odd = np.array([-1.0, 0.0, 1e-42, np.inf], np.float32)
    assert RUNTIME.apply(Function.LOG, odd)[:3] == pytest.approx(np.log(LEAST), rel=1e-6)
    assert EXACT.apply(Function.LOG, odd.astype(np.float64))[:2] == pytest.approx(np.log(LEAST))
    assert np.isfinite(RUNTIME.apply(Function.LOG, odd)).all()
    assert np.isnan(RUNTIME.apply(Function.LOG, np.array([np.nan], np.float32))).all()


def test_a_layer_may_be_a_logarithm():
    build = Builder(2)
    build.add(Activate, "log", INPUT, function=Function.LOG, size=2)
    assert build.graph({"prediction": "log"}, 1).layers[0].options()["function"] is Function.LOG
