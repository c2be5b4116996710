"""Soil: published figures, mass, passivity, bounds, and what a bad material file says."""

import itertools
from importlib import resources

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.sim import Scenario, load_machine, simulate
from edp.sim.machine import layout as at
from edp.sim.physics import soil
from edp.sim.physics import terramechanics as tm
from edp.sim.physics.material import load_material, material_names, parse_material
from edp.sim.physics.plant import Plant

MATERIALS = material_names()


def ground(name, seed=0, machine="M22"):
    return soil.Ground(load_material(name), load_machine(machine), np.random.default_rng(seed))


def dig(name, seconds=20.0, seed=0, step_s=1e-3):
    """Full levers flung to and fro, the boom mostly down."""
    own, rng = ground(name, seed), np.random.default_rng(seed + 1)
    plant = Plant(load_machine("M22"), np.array([0.6, 0.4, 0.4]), step_s=step_s, ground=own)
    logs = []
    for block in range(round(seconds)):
        levers = np.tile(rng.choice([-1.0, 1.0], 3), (100, 1))
        levers[:, 0] = -0.5 if block % 2 else levers[0, 0]
        logs.append(plant.run(levers))
    return own, np.concatenate(logs)


@pytest.mark.parametrize(
    ("name", "expected_kn"),
    [("dry_sand", (0.5, 1.6, 3.2)), ("sandy_loam", (1.5, 3.6, 6.3)), ("clay", (5.8, 12.0, 19.0))],
)
def test_cutting_forces_meet_the_earthmoving_equation(name, expected_kn):
    own = ground(name)
    found = [tm.cutting_force(d, np.radians(55.0), 0.0, own.numbers, own.tables) / 1e3 for d in (0.1, 0.2, 0.3)]
    assert found == pytest.approx(expected_kn, rel=0.05, abs=0.05)


@pytest.mark.parametrize("name", MATERIALS)
def test_cutting_factors_are_positive_at_every_rake(name):
    table = tm.cutting_table(load_material(name))
    assert np.isfinite(table).all()
    assert table[:, :2].min() > 0.5
    assert table[:, 2].min() >= 0.0


@pytest.mark.parametrize("name", MATERIALS)
def test_a_wild_dig_keeps_mass_and_stays_bounded(name):
    own, log = dig(name, seconds=2.0)
    before = ground(name).mass_kg
    own, log = dig(name)
    assert np.isfinite(log).all()
    assert own.mass_kg == pytest.approx(before, rel=1e-12)
    assert log[:, at.LOG_EVENTS + at.SOIL_CONTACT].mean() > 0.2
    assert log[:, at.LOG_PAYLOAD].max() > 100.0
    assert log[:, at.LOG_PAYLOAD].max() <= own.numbers[tm.CAPACITY] * (1 + 1e-9)
    assert (np.hypot(log[:, at.LOG_FORCE], log[:, at.LOG_FORCE + 1]) < 4e5).all()
    pressures = log[:, at.HEAD : at.BRISTLE] + at.ATMOSPHERE
    assert pressures.min() >= 0.1e5 - 1
    assert pressures.max() < 425e5


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_dig_cycles_stay_bounded(machine, name):
    recording = simulate(Scenario(machine=machine, excitation="dig", material=name, duration_s=60, seed=2))
    force = np.hypot(recording.column("TipForceX"), recording.column("TipForceY"))
    assert 2e4 < force.max() < 4e5
    rates = np.stack([recording.column(f"JointVel_{i}") for i in (1, 2, 3)])
    assert np.abs(rates).max() < 4.0
    assert recording.column("Payload").max() > 100.0


def test_soil_never_drives_the_bucket():
    own = ground("gravel")
    rng = np.random.default_rng(5)
    contact = np.zeros(tm.CONTACTS)
    contact[[tm.ON, tm.DRAG, tm.ACROSS, tm.EDGE, tm.SLIDE]] = 1.0, 3e4, 1e4, 2e4, 1e4
    for angle, _ in itertools.product(np.linspace(-3, 3, 13), range(20)):
        contact[tm.EDGE_X], contact[tm.EDGE_Y] = np.cos(angle), np.sin(angle)
        v = tuple(rng.normal(0, rng.choice([1e-3, 0.1, 2.0]), 4))
        fx, fy, hx, hy = tm.forces(contact, v)
        assert fx * v[0] + fy * v[1] <= 1e-9
        assert hx * v[2] <= 0.0
        assert hy == 0.0
    assert own.material.name == "gravel"


def test_same_seed_same_bits():
    first, second = dig("sandy_loam", 4.0)[1], dig("sandy_loam", 4.0)[1]
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - dig("sandy_loam", 4.0, seed=3)[1]).max() > 0


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_pressing_down_lifts_the_machine_and_no_more(machine):
    own = ground("gravel", machine=machine)
    chassis = load_machine(machine).chassis
    plant = Plant(load_machine(machine), np.array([0.5, 0.4, 0.6]), ground=own)
    log = plant.run(np.tile([-0.3, 0.0, 0.0], (700, 1)))
    up = log[-100:, at.LOG_FORCE + 1] * log[-100:, at.LOG_TIP]
    assert up.max() > 0.6 * chassis.lift_moment
    assert np.median(up) < 1.5 * chassis.lift_moment
    assert 0.0 < own.memory[at.PITCH] < 0.5


def test_a_load_is_felt_and_spilled():
    own = ground("dry_sand")
    machine = load_machine("M22")
    plant = Plant(machine, np.array([0.85, 0.5, 0.95]), ground=own)
    own.memory[at.PAYLOAD] = 1000.0
    before = own.mass_kg
    held = plant.run(np.zeros((200, 3)))
    assert plant.payload_kg == pytest.approx(held[-1, at.LOG_PAYLOAD])
    assert plant.axes[2, at.MASS] == pytest.approx(machine.bodies.mass[2] + plant.payload_kg)
    plant.run(np.tile([0.0, 0.0, -1.0], (300, 1)))
    assert plant.payload_kg < 100.0
    assert own.mass_kg == pytest.approx(before, rel=1e-12)


def test_a_new_material_is_a_file(tmp_path):
    text = (resources.files("edp.sim") / "materials" / "clay.toml").read_text()
    path = tmp_path / "mud.toml"
    path.write_text(text.replace('"clay"', '"mud"').replace("cohesion = 25e3", "cohesion = 4.1e3"))
    mud = load_material(str(path))
    assert (mud.name, mud.cohesion) == ("mud", 4.1e3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("density = 1900.0", "density = -1.0"), "density = -1.0; 500 <= density <= 3,500 must hold"),
        (("swell = 1.35", ""), "'swell' is missing"),
        (("swell = 1.35", "swel = 1.35"), "unknown key 'swel'; did you mean 'swell'"),
        (
            ("[0.6e6, 2.5e6]", "[2.5e6, 0.6e6]"),
            "cone_index = [2500000.0, 600000.0] Pa; the smaller one must come first",
        ),
        (("[0.6e6, 2.5e6]", "[0.0, 2.5e6]"), "cone_index = [0.0, 2500000.0]; 0 < cone_index"),
        (("[0.6e6, 2.5e6]", "0.6e6"), "cone_index = 600000.0: a list must hold"),
        (("density = 1900.0", "density = '1900'"), "density = '1900': a text is no number"),
        (("swell = 1.35", "swell = "), "not valid TOML"),
    ],
)
def test_bad_materials_are_refused(change, says):
    text = (resources.files("edp.sim") / "materials" / "clay.toml").read_text()
    with pytest.raises(ConfigError, match=r"mud\.toml") as refused:
        parse_material(text.replace(*change), "mud.toml")
    assert says in str(refused.value)


def test_unknown_material_offers_the_closest():
    with pytest.raises(ConfigError, match="sandy_loam"):
        load_material("sandy_loan")
