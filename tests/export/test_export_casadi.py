"""The CasADi step and the C behind its external function against PyTorch, with their derivatives, and their rules."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.errors import ExportError
from edp.export import make_target
from edp.export.casadi.target import CasadiTarget
from edp.export.golden import random_inputs, stream, tolerance
from edp.networks.backbones import LstmSpec
from edp.networks.predictor import ModelSpec, build_model
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle

casadi = pytest.importorskip("casadi", reason="needs casadi: pip install 'excavator-dynamics-predictor[casadi]'")
from edp.export.casadi import runtime  # noqa: E402
from edp.export.casadi.horizon import Horizon  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning")  # PyTorch's own, at jvp
NETWORKS = ("hybrid+all", "hybrid9", "tcn+all", "gru+quantiles", "lstm2", "lstm+hybrid physics")
"""Among them all kinds of layers."""
TICKS = 30
EXAMPLES = Path(__file__).parents[2] / "examples"
TOLERANCE = 1e-4


@pytest.fixture(scope="session")
def network_of(bundle_of, tmp_path_factory):
    made = {}

    def make(structure):
        if structure not in made:
            folder = tmp_path_factory.mktemp("casadi")
            CasadiTarget().write(bundle_of(structure), "predictor", folder)
            made[structure] = runtime.Network(folder / "predictor.json")
        return made[structure]

    return make


@pytest.fixture(scope="session")
def external_of(c, network_of):
    made = {}

    def make(structure):
        c.need("gcc")
        if structure not in made:
            made[structure] = network_of(structure).compile("gcc", *c.flags[1:], "-O1")
        return network_of(structure).external(made[structure])

    return make


def run(step, start, inputs):
    """Results of a stream ``(tick, number)`` and the states before each tick."""
    x, found, states = start, [], []
    for row in inputs:
        states.append(np.array(x).ravel())
        x, *results = step(x, row)
        found.append(np.concatenate([np.array(part).ravel() for part in results]))
    return np.array(found), states


def run_changes(step, start, inputs, changes):
    """Changes of the results along one direction, by CasADi's forward derivative."""
    along, x, dx, found = step.forward(1), start, np.zeros(len(start)), []
    for row, change in zip(inputs, changes, strict=True):
        results = step(x, row)
        dx, *moved = along(x, row, *results, dx, change)
        x = results[0]
        found.append(np.concatenate([np.array(part).ravel() for part in moved]))
    return np.array(found)


@pytest.mark.covering
def test_steps_and_derivatives_are_those_of_pytorch(structure, bundle_of, network_of, changes_of, torch_changes):
    """1e-5 for predictions; 1e-4 of the largest change for derivatives through the past."""
    predictor, network = bundle_of(structure).predictor, network_of(structure)
    inputs = random_inputs(predictor, TICKS, seed=5)
    wanted = stream(predictor, inputs)
    found, _ = run(network.step, network.start, inputs)
    assert (np.abs(found - wanted) < tolerance(predictor, inputs, wanted)).all()
    changes = changes_of(predictor, TICKS, 1)[:, 0].astype(np.float32)
    moved = torch_changes(predictor, inputs, changes)
    error = np.abs(run_changes(network.step, network.start, inputs, changes) - moved).max(axis=0)
    assert (error / np.abs(moved).max(axis=0)).max() < TOLERANCE


def relative(found, wanted):
    return np.abs(np.array(found) - np.array(wanted)).max() / max(1e-30, np.abs(np.array(wanted)).max())


@pytest.mark.parametrize("network", NETWORKS)
def test_the_c_behind_it_gives_the_same_steps_and_jacobian(network, bundle_of, network_of, external_of):
    """From states of its own, rings half full and full; compiled with warnings as errors.

    Of rows that were not seen yet, which are zero, the C code takes no derivative: Jacobians are held with full rings.
    """
    predictor, step, start = bundle_of(network).predictor, network_of(network).step, network_of(network).start
    external = external_of(network)
    assert [external.name_out(i) for i in range(external.n_out())] == [step.name_out(i) for i in range(step.n_out())]
    inputs = random_inputs(predictor, TICKS, seed=5)
    wanted = stream(predictor, inputs)
    found, states = run(external, start, inputs)
    assert (np.abs(found - wanted) < tolerance(predictor, inputs, wanted)).all()
    _, exact = run(step, start, inputs)
    assert max(np.abs(a - b).max() / (1 + np.abs(b).max()) for a, b in zip(states, exact, strict=True)) < 1e-4
    at = (exact[20], inputs[20], *[0] * step.n_out())
    for own, other in zip(external.jacobian()(*at), step.jacobian()(*at), strict=True):
        assert relative(own, other) < TOLERANCE


@pytest.mark.parametrize("network", ["hybrid+all", "lstm2"])
def test_a_horizon_in_c_is_that_of_casadi(network, bundle_of, network_of, external_of):
    """Predictions fed back, one input carried; Jacobian by two commands."""
    made, predictor = network_of(network), bundle_of(network).predictor
    external_of(network)
    inputs, width, steps = random_inputs(predictor, 20, seed=4), made.step.numel_out(1), 8
    rng = np.random.default_rng(0)
    carry, feed = np.zeros(len(made.inputs)), np.zeros((len(made.inputs), width))
    carry[2], feed[0, 0], feed[1, width - 1] = 1.0, 1.0, 0.5
    base, first = rng.normal(size=(steps, len(made.inputs))), inputs[-1]
    commands = made.inputs[-2:]
    x = run(made.step, made.start, inputs)[1][-1]
    library = made.path.with_name("predictor_external.so")
    fast = Horizon(made, library, steps, 2, carry, feed)
    by = np.tile(np.eye(len(made.inputs))[-2:], (steps, 1, 1))
    y, jacobian = fast(x, first, base, by)
    plan = made.horizon(steps, carry, feed)
    assert relative(y, np.array(plan(x, first, base.T)).T) < TOLERANCE
    by_first, by_base = plan.jacobian()(x, first, base.T, 0)[1:3]
    columns = [made.inputs.index(name) for name in commands]
    wanted = np.array(by_base).reshape(steps, width, steps, -1)[..., columns]
    wanted[:, :, 0] = np.array(by_first).reshape(steps, width, -1)[..., columns]
    assert relative(jacobian, wanted) < TOLERANCE
    first[0] = np.nan
    with pytest.raises(ValueError, match=r"inputs of tick 0 .* not finite"):
        fast(x, first, base, by)
    with pytest.raises(ValueError, match="numbers"):
        fast(x, first[1:], base, by)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_inputs_never_give_a_number_that_looks_sound(bad, bundle_of, network_of, external_of):
    network, external = network_of("hybrid+all"), external_of("hybrid+all")
    row = random_inputs(bundle_of("hybrid+all").predictor, 1, seed=1)[0]
    for column in range(len(row)):
        spoilt = row.copy()
        spoilt[column] = bad
        made = np.concatenate([np.array(part).ravel() for part in network.step(network.start, spoilt)])
        assert np.isnan(made).any()
        with pytest.raises(RuntimeError):
            external(network.start, spoilt)
    with pytest.raises(Exception, match="dimension"):
        network.step(network.start, row[1:])
    with pytest.raises(ValueError, match=r"inputs lever.* are missing"):
        network.order([name for name in network.inputs if name != "lever"])
    assert network.order(network.inputs[::-1]) == list(range(len(row)))[::-1]


def test_it_needs_no_edp_and_no_torch(network_of):
    program = """
import sys; sys.path.insert(0, sys.argv[1])
import numpy as np
from edp_casadi import Network
network = Network(sys.argv[1] + "/predictor.json")
golden = np.load(sys.argv[1] + "/predictor_golden.npz")
x, worst = network.start, 0
for row, wanted in zip(golden["inputs"][:50], golden["stream"]):
    x, *found = network.step(x, row)
    found = np.concatenate([np.array(part).ravel() for part in found])
    worst = max(worst, np.abs((found - wanted) / golden["tolerance"]).max())
assert worst < 1, worst
assert not {"torch", "edp", "onnx"} & set(sys.modules)
"""
    folder = network_of("hybrid+all").path.parent
    subprocess.run([sys.executable, "-I", "-c", program, str(folder)], check=True, capture_output=True)


def test_what_is_not_known_is_refused(bundle_of, network_of, tmp_path):
    with pytest.raises(ExportError, match="integer arithmetic"):
        make_target("casadi").write(bundle_of("hybrid", True), "predictor", tmp_path)
    with pytest.raises(ExportError, match="--name"):
        make_target("casadi").write(bundle_of("lstm"), "2b", tmp_path)
    assert not list(tmp_path.iterdir())
    path = network_of("lstm").path
    about = json.loads(path.read_text())
    other = path.with_name("other.json")
    other.with_suffix(".npz").write_bytes(path.with_suffix(".npz").read_bytes())
    other.write_text(json.dumps(about | {"schema": 2}))
    with pytest.raises(ValueError, match="schema 2"):
        runtime.Network(other)
    about["layers"][0]["kind"] = "Strange"
    other.write_text(json.dumps(about))
    with pytest.raises(ValueError, match="is a Strange"):
        runtime.Network(other)
    with pytest.raises(RuntimeError, match="does not start"):
        network_of("lstm").compile("no-such-compiler")


@pytest.mark.slow
def test_the_example_tracks(c, tmp_path):
    """With an untrained plant: it runs, and every way ends with numbers."""
    c.need("gcc")
    task = load_experiment(EXAMPLES / "mpc.toml").task
    names = tuple(task.features.channels)
    scaler = Scaler(np.zeros(9), np.r_[np.full(3, 0.1), np.full(6, 1e6)], np.zeros((1, 3)), np.full((1, 3), 0.01))
    made = Task(FeatureSet("plant", names), names[:3], (1,), task.mode, 100.0)
    predictor = build_model(made, ModelSpec(backbone=LstmSpec(units=4), window=5), scaler, seed=1).eval()
    kinds = [Kind.VELOCITY] * 3 + [Kind.PILOT_PRESSURE] * 6
    inputs = tuple(Channel(name, kind, "an input") for name, kind in zip(names, kinds, strict=True))
    CasadiTarget().write(Bundle(predictor, inputs, (Kind.VELOCITY,) * 3, names[:3]), "plant", tmp_path)
    command = [sys.executable, EXAMPLES / "mpc.py", tmp_path / "plant.json", "1"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    assert lines[0].startswith("C horizon + DAQP")
    assert len(lines) == 3
    assert all("nan" not in line for line in lines)
