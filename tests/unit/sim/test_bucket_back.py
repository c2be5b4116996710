"""The back of the bucket pushes soil: passive pressure, mass, no energy, heaps, prints of the heel, refusals."""

import dataclasses
from importlib import resources

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.sim import Scenario, Simulation, load_machine
from edp.sim.machine import layout as at
from edp.sim.physics import bucket_back, ground_profile, soil
from edp.sim.physics import terramechanics as tm
from edp.sim.physics.material import load_material, material_names
from edp.sim.physics.plant import Plant
from edp.sim.physics.pose import Kinematics

MATERIALS = material_names()


def ground(push, name="sandy_loam", friction_deg=10.0, seed=0):
    changes = {"back_push": push, "back_friction_deg": friction_deg if push else 0.0}
    material = dataclasses.replace(load_material(name), **changes)
    return soil.Ground(material, load_machine("M22"), np.random.default_rng(seed))


def pushed(push, seconds=3.0, step_s=1e-3, name="sandy_loam", attitude=-2.0):
    """The bucket set down upright (or, from -2.3 rad, on its heel), then the arm thrown out along the ground."""
    own, machine = ground(push, name), load_machine("M22")
    probe = Plant(machine, np.full(3, 0.5))
    strokes = Kinematics(probe.axes, probe.plant).strokes_at(4.5, own.height(4.5) + 0.05, attitude)
    plant = Plant(machine, strokes, step_s=step_s, ground=own)
    lowered = plant.run(np.tile([-0.3, 0.0, 0.0], (90, 1)))
    return own, np.concatenate([lowered, plant.run(np.tile([0.0, -0.6, 0.0], (round(100 * seconds), 1)))])


def test_passive_coefficient_is_rankines_without_friction_on_the_wall_and_as_tabulated_with_it():
    for degrees in (10.0, 30.0, 45.0):
        phi = np.radians(degrees)
        assert bucket_back.passive_coefficient(phi, 0.0) == pytest.approx(np.tan(np.pi / 4 + phi / 2) ** 2)
    # By slip lines (Kerisel and Absi's tables) 30 and 20 deg have 5.1 to 5.3; a lower bound stays a little below.
    assert 4.3 < bucket_back.passive_coefficient(np.radians(30.0), np.radians(20.0)) < 5.3
    grows = [bucket_back.passive_coefficient(np.radians(35.0), np.radians(wall)) for wall in range(36)]
    assert (np.diff(grows) > 0.0).all()


def test_force_is_that_of_the_earth_before_a_wall():
    own = ground(1.0, "clay", 0.0)
    material, width = own.material, own.numbers[tm.WIDTH]
    k = np.tan(np.pi / 4 + np.radians(material.friction_deg) / 2) ** 2
    for depth in (0.05, 0.3, 1.0):
        rankine = 0.5 * material.density * 9.81 * k * depth**2 + 2.0 * material.cohesion * np.sqrt(k) * depth
        assert bucket_back.pressure(depth, depth, own.numbers[tm.BACK :]) == pytest.approx(width * rankine, rel=1e-9)
        # Of a heap on level ground the weight alone counts.
        heaped = 2.0 * width * material.cohesion * np.sqrt(k) * depth
        less = bucket_back.pressure(depth, -1.0, own.numbers[tm.BACK :])
        assert less == pytest.approx(width * rankine - heaped, rel=1e-9)
    # Without friction a cohesive soil has 2 c a metre of depth.
    soft = dataclasses.replace(own.material, friction_deg=0.0, metal_friction_deg=0.0)
    assert bucket_back.pack(soft, 1.0)[bucket_back.HOLD] == pytest.approx(2.0 * soft.cohesion, rel=5e-3)


def test_without_it_nothing_changes():
    assert not ground(0.0).numbers[tm.BACK :].any()
    heights = ground(0.0).heights
    own, log = pushed(0.0)
    # The edge cuts a little on its way in; nothing is heaped up anywhere.
    assert (own.heights <= heights + 0.01).all()
    assert log[:, at.LOG_EVENTS + at.SOIL_CONTACT].any()


@pytest.mark.parametrize(("push", "attitude"), [(0.3, -2.0), (1.0, -1.6), (1.0, -2.7)])
@pytest.mark.parametrize("name", MATERIALS)
def test_an_arm_thrown_out_heaps_soil_before_the_back_and_keeps_its_mass(name, push, attitude):
    before, start = ground(push, name), ground(push, name).heights
    own, log = pushed(push, name=name, attitude=attitude)
    assert np.isfinite(log).all()
    assert own.mass_kg == pytest.approx(before.mass_kg, rel=1e-12)
    risen = np.maximum(own.heights - start, 0.0).sum() * own.spacing_m
    assert risen > 0.02
    assert log[-1, at.LOG_TIP] > 4.8
    assert np.hypot(log[:, at.LOG_FORCE], log[:, at.LOG_FORCE + 1]).max() < 4e5


def test_soil_lies_ahead_of_the_back_and_the_share_behind_it():
    own, points = ground(0.75), np.array([5.0, 0.0, 5.0, 0.4])
    own.heights[:] = 0.0
    points[1] = -0.1
    for _ in range(1000):
        bucket_back.push(points, 1e-3, 0.75, own.heights, own.memory)
        points[[0, 2]] += 1e-3
    ahead, behind = own.heights[121:].sum(), own.heights[: round(5.0 / own.spacing_m)].sum()
    assert own.heights.sum() == pytest.approx(0.0, abs=1e-12)
    assert ahead > 10.0 * abs(behind)
    # A cell that the back has passed lies on its path, but for what flowed around it.
    assert (own.heights[105:117] < -0.1 + 0.25 * 4.0).all()
    whole = ground(1.0)
    whole.heights[:] = 0.0
    points = np.array([5.0, -0.1, 5.0, 0.4])
    for _ in range(1000):
        bucket_back.push(points, 1e-3, 1.0, whole.heights, whole.memory)
        points[[0, 2]] += 1e-3
    np.testing.assert_allclose(whole.heights[102:118], -0.1, atol=1e-9)


def test_what_the_heel_shoves_aside_stands_on_either_side_unless_it_was_compacted():
    own, x = ground(1.0), 5.0
    own.heights[:] = 0.0
    bucket_back.shove_aside(x, 0.04, own.heights, own.memory)
    middle = round(x / own.spacing_m)
    np.testing.assert_allclose(own.heights[middle - 2 : middle + 3], -0.04)
    assert own.heights[middle - 3] > 0.0
    assert own.heights[middle - 3] == pytest.approx(own.heights[middle + 3])
    assert own.heights.sum() == pytest.approx(0.0, abs=1e-12)
    dense = ground(1.0)
    dense.heights[:] = 0.0
    ground_profile.press(x, -0.04, 1.0, dense.heights, dense.memory)
    bucket_back.shove_aside(x, 0.04, dense.heights, dense.memory)
    assert not dense.heights.any()


def contact_at(own, rng):
    """Contact of a bucket somewhere in the ground with random rates of its joints."""
    machine = load_machine("M22")
    plant = Plant(machine, rng.uniform([0.2, 0.4, 0.2], [0.4, 0.8, 0.9]), ground=own)
    state = plant.state.copy()
    state[at.RATE : at.RATE + 3] = rng.normal(0.0, 0.3, 3)
    angle = np.cumsum(state[at.PSI : at.PSI + 3])
    angles = np.stack([np.cos(angle), np.sin(angle)], axis=1).ravel()
    tip = plant.axes[:, at.LENGTH] @ np.sin(angle)
    own.heights[:] = tip + rng.uniform(-0.1, 0.5)
    contact = np.zeros(tm.CONTACTS)
    tm.engage(state, angles, plant.axes, own.arrays(), contact)
    return state, contact


def test_soil_before_the_back_never_drives_the_bucket_and_the_jacobian_knows_it():
    rng, met = np.random.default_rng(3), 0
    for _ in range(60):
        own = ground(1.0, str(rng.choice(MATERIALS)))
        state, contact = contact_at(own, rng)
        if contact[tm.ON] == 0.0:
            continue
        met += contact[tm.PUSH_DEPTH] > 0.0
        # Elastic support of the heel gives back what it took: left out of the balance.
        contact[tm.NORMAL] = 0.0
        rates = state[at.RATE : at.RATE + 3]
        v = tm.velocities(contact, *rates)
        fx, fy, hx, hy = tm.forces(contact, v)
        assert fx * v[0] + fy * v[1] + hx * v[2] + hy * v[3] <= 1e-9
        torques = np.array(tm.torques(contact, *rates))
        damping = contact[tm.DAMPING : tm.DAMPING + 9].reshape(3, 3)
        further = np.array([np.array(tm.torques(contact, *(rates + step))) - torques for step in np.eye(3)]).T
        np.testing.assert_allclose(further, -damping, rtol=1e-6, atol=1e-6 * np.abs(damping).max())
    assert met > 10


def test_it_converges_as_the_front_does():
    """1 ms against 0.25 ms: what the docs give for a dig in loam is 0.6 mm/s."""
    coarse, fine = pushed(1.0, 2.0)[1], pushed(1.0, 2.0, 0.25e-3)[1]
    difference = coarse[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3] - fine[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    assert np.sqrt((difference**2).mean(axis=0)).max() < 3e-3


def test_a_snapshot_goes_on_to_the_bit(tmp_path):
    text = (resources.files("edp.sim") / "materials" / "sandy_loam.toml").read_text()
    path = tmp_path / "pushed.toml"
    path.write_text(text + "\nback_push = 0.8\nback_friction_deg = 12.0\n")
    simulation = Simulation(Scenario(excitation="grading", material=str(path), duration_s=12.0, seed=4))
    simulation.run(600)
    moment = simulation.snapshot()
    moment.save(tmp_path / "m.npz")
    expected = simulation.run(500)
    again = Simulation.from_snapshot(type(moment).load(tmp_path / "m.npz"))
    np.testing.assert_array_equal(again.run(500), expected)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"back_push": -0.1}, "back_push"),
        ({"back_push": 1.1}, "back_push"),
        ({"back_push": float("nan")}, "back_push"),
        ({"back_push": 1e300}, "back_push"),
        ({"back_push": 0.5, "back_friction_deg": float("nan")}, "back_friction_deg"),
        ({"back_push": 0.5, "back_friction_deg": -1.0}, "back_friction_deg"),
        ({"back_push": 0.5, "back_friction_deg": 30.0}, "at most friction_deg"),
        ({"back_friction_deg": 5.0}, "needs a back that pushes soil"),
    ],
)
def test_what_cannot_be_is_refused(changes, says):
    with pytest.raises(ConfigError, match=says):
        dataclasses.replace(load_material("clay"), **changes)
