"""A grey box for CasADi: its ticks are those of the Python kernel, its derivatives those of its own ticks."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from edp.export.golden import random_inputs
from edp.ir.hydraulics import NONE
from edp.networks.twin import TwinPlant
from edp.networks.twin.grey import linkage, parameter_index, tick
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.residual import Residual
from edp.testing.twins import sample_front, sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle

casadi = pytest.importorskip("casadi", reason="needs casadi: pip install 'excavator-dynamics-predictor[casadi]'")
from edp.export.casadi import CasadiTarget, hydraulics, runtime  # noqa: E402

TWINS = ("polynomials", "bodies", "network")


def twin_of(name):
    if name == "bodies":
        return sample_twin(GreyBox(linkage="M22"), sample_front())[0]
    return sample_twin(Residual() if name == "network" else GreyBox())[0]


@pytest.fixture(scope="module")
def network_of(tmp_path_factory):
    made = {}

    def make(name):
        if name not in made:
            folder, twin = tmp_path_factory.mktemp("casadi"), twin_of(name)
            CasadiTarget().write(plant_bundle(TwinBundle(twin.spec, twin)), "plant", folder)
            # What is written imports this file by its own name.
            sys.modules["edp_hydraulics"] = hydraulics
            made[name] = runtime.Network(folder / "plant.json")
        return made[name]

    yield make
    sys.modules.pop("edp_hydraulics", None)


def streamed(built, rows):
    x, answers = built.start, []
    for row in rows:
        x, y = built.step(x, row)
        answers.append(np.array(y).ravel())
    return np.array(answers), np.array(x).ravel()


@pytest.mark.parametrize("name", TWINS)
def test_ticks_are_those_of_the_twin(name, network_of):
    built = network_of(name)
    golden = np.load(built.path.with_name("plant_golden.npz"))
    found, state = streamed(built, golden["inputs"][:80])
    assert (np.abs(found - golden["stream"][:80]) / golden["tolerance"]).max() < 1.0
    assert np.isfinite(state).all()


@pytest.mark.parametrize("name", ["polynomials", "bodies"])
def test_wild_free_runs_stay_numbers(name, network_of):
    """Levers to and fro from drawn starts: checks and reliefs toggle, where plain Newton steps do not end."""
    built, plant = network_of(name), TwinPlant(twin_of(name), name)
    found, state = streamed(built, random_inputs(plant, 60, seed=2, mixed=False))
    assert np.isfinite(found).all()
    assert np.isfinite(state).all()


def test_derivatives_are_those_of_its_own_ticks(network_of):
    built = network_of("bodies")
    golden = np.load(built.path.with_name("plant_golden.npz"))
    _, x = streamed(built, golden["inputs"][:30])
    row, along = golden["inputs"][30], built.step.forward(1)
    rng = np.random.default_rng(0)
    change, size = rng.normal(size=len(x)), 1e-6
    results = built.step(x, row)
    slope = np.array(along(x, row, *results, change, np.zeros(len(row)))[1]).ravel()
    ahead, behind = (np.array(built.step(x + way * size * change, row)[1]).ravel() for way in (1.0, -1.0))
    assert np.abs((ahead - behind) / (2.0 * size) - slope).max() < 1e-3 * np.abs(slope).max()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_command_that_is_no_number_gives_none(bad, network_of):
    built = network_of("polynomials")
    row = np.load(built.path.with_name("plant_golden.npz"))["inputs"][0].copy()
    row[0] = bad
    _, state = streamed(built, row[None])
    assert np.isnan(state).any()


def test_what_nodes_hold_gives_their_pressure_back(network_of):
    built = network_of("polynomials")
    part = next(layer for layer in built.about["layers"] if layer["kind"] == "HydraulicTick")
    arrays = {name: built._arrays[f"{part['name']}/{name}"] for name in part["constants"]}
    machine = hydraulics.HydraulicMachine(part, arrays)
    p = np.r_[np.geomspace(1e-6, 40.0, machine.nodes) - parameter_index.ATMOSPHERE, np.zeros(machine.n)]
    assert np.allclose(np.array(machine.pressures(machine.contents(casadi.DM(p)))).ravel(), p, rtol=1e-9, atol=1e-9)


def test_constants_are_those_of_the_kernel():
    assert (hydraulics.MISSING, hydraulics.STAGE_RATIO) == (NONE, tick.STAGE_RATIO)
    assert (hydraulics.EXTRAPOLATION, hydraulics.NEWTON["abstolStep"]) == (linkage.BEYOND, tick.TOLERANCE)


def test_it_needs_no_edp_and_has_no_c(network_of):
    built = network_of("polynomials")
    program = """
import sys; sys.path.insert(0, sys.argv[1])
import numpy as np
from edp_casadi import Network
network = Network(sys.argv[1] + "/plant.json")
golden = np.load(sys.argv[1] + "/plant_golden.npz")
x, y = network.step(network.start, golden["inputs"][0])
assert (np.abs(np.array(y).ravel() - golden["stream"][0]) < golden["tolerance"][0]).all()
assert not {"torch", "edp", "numba"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-I", "-c", program, str(built.path.parent)], check=True, capture_output=True)
    with pytest.raises(RuntimeError, match="holds no C code"):
        built.compile()
