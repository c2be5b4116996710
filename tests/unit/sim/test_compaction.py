"""Soil that keeps what the heel has pressed: repeated loading, work, mass, ruts that are cut away, refusals."""

import dataclasses

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.physics import ground_profile, soil, terrain
from edp.sim.physics import terramechanics as tm
from edp.sim.physics.material import load_material
from edp.sim.physics.plant import Plant

HEEL_X = 5.0


def ground(compaction, name="sandy_loam", seed=0):
    material = dataclasses.replace(load_material(name), compaction=compaction)
    return soil.Ground(material, load_machine("M22"), np.random.default_rng(seed))


def strokes(own, depths, x=HEEL_X):
    """Normal forces (N) of a heel that is pressed to each depth (m below the profile) in turn, in air at the end."""
    contact, forces = np.zeros(tm.CONTACTS), []
    top = tm.height_at(x, own.heights)
    for depth in depths:
        contact[tm.POINTS + 2], contact[tm.POINTS + 3] = x, top - depth
        contact[tm.HEEL_DEPTH], contact[tm.NORMAL] = depth, 0.0
        # As `engage` asks: within a rut there is nothing to touch.
        if depth > ground_profile.rut_depth(x, own.heights, own.memory):
            tm.engage_heel(own.numbers, own.heights, own.memory, contact)
        else:
            own.memory[at.HEEL_SET] = 0.0
        forces.append(contact[tm.NORMAL])
    own.memory[at.HEEL_SET] = 0.0
    return np.array(forces)


STEP_M = 1e-4
DOWN = STEP_M * np.arange(201)
PASS = np.concatenate((DOWN, DOWN[::-1]))


def work(forces, depths):
    return float(np.trapezoid(forces, depths))


def test_what_was_pressed_bears_at_once_and_beyond_it_follows_the_virgin_curve():
    own = ground(1.0)
    first = strokes(own, PASS)[: len(DOWN)]
    rut = own.ruts_m[round(HEEL_X / tm.SPACING)]
    assert 0.005 < rut < 0.02
    depths = STEP_M * np.arange(271)
    again, virgin = strokes(own, depths), own.numbers[tm.BEKKER] * depths ** own.numbers[tm.EXPONENT]
    # Below what the soil bears without giving way altogether.
    assert virgin[-1] < own.numbers[tm.BEARING_LIMIT]
    first_felt = int(rut / STEP_M)
    assert not again[:first_felt].any()
    np.testing.assert_allclose(again[205:], virgin[205:], rtol=1e-9)
    stiff = np.diff(again)[first_felt + 2 : 195] / STEP_M
    np.testing.assert_allclose(stiff, own.numbers[tm.UNLOADING], rtol=1e-6)
    assert again[200] == pytest.approx(first[200], rel=1e-6)


def test_a_second_pass_costs_the_elastic_part_alone_and_none_gives_energy():
    """Work of three passes to the same depth, and what comes back from each."""
    for compaction, later in ((1.0, 0.35), (0.0, 1.01)):
        own, costs = ground(compaction), []
        for _ in range(3):
            forces = strokes(own, PASS)
            costs.append(work(forces[: len(DOWN)], DOWN))
            assert work(forces, PASS) > -1e-9 * costs[0]
        assert costs[1] < later * costs[0]
        assert costs[1] == pytest.approx(costs[2], rel=1e-6)
        assert (costs[1] == pytest.approx(costs[0], rel=1e-9)) == (compaction == 0.0)


def test_half_of_it_rebounds():
    whole, half = ground(1.0), ground(0.5)
    strokes(whole, PASS)
    strokes(half, PASS)
    middle = round(HEEL_X / tm.SPACING)
    assert half.ruts_m[middle] == pytest.approx(0.5 * whole.ruts_m[middle])
    assert not ground(0.0).ruts_m.any()


def test_a_rut_lowers_the_surface_and_not_the_mass():
    own = ground(1.0)
    mass, height = own.mass_kg, own.height(HEEL_X)
    strokes(own, PASS)
    assert own.mass_kg == mass
    assert own.height(HEEL_X) < height - 0.005
    assert np.count_nonzero(own.ruts_m) == pytest.approx(5, abs=1)


def test_a_cut_below_a_rut_takes_it_away_with_its_mass():
    own = ground(1.0)
    strokes(own, PASS)
    before, k = own.mass_kg, round(HEEL_X / tm.SPACING)
    contact = np.zeros(tm.CONTACTS)
    contact[tm.POINTS], contact[tm.POINTS + 1] = HEEL_X - 0.2, own.heights[k] - 0.15
    terrain.sweep(contact, 0.5, own.numbers, own.heights, own.memory)
    assert own.payload_kg > 50.0
    assert own.mass_kg == pytest.approx(before, rel=1e-12)
    assert not own.ruts_m[k - 3 : k + 4].any()
    # An edge in the air of the rut cuts nothing.
    other = ground(1.0)
    strokes(other, PASS)
    contact[tm.POINTS], contact[tm.POINTS + 1] = HEEL_X - 0.02, other.heights[k] - 0.5 * other.ruts_m[k]
    heights = other.heights.copy()
    terrain.sweep(contact, 0.03, other.numbers, other.heights, other.memory)
    np.testing.assert_array_equal(other.heights[k], heights[k])


def levelled(compaction):
    """The bucket set down, moved and lifted at full levers: most of it pressing and pushing."""
    own, rng = ground(compaction), np.random.default_rng(1)
    plant = Plant(load_machine("M22"), np.array([0.6, 0.4, 0.4]), ground=own)
    logs = []
    for block in range(8):
        levers = np.tile(rng.choice([-1.0, 1.0], 3), (100, 1))
        levers[:, 0] = -0.5 if block % 2 else levers[0, 0]
        logs.append(plant.run(levers))
    return own, np.concatenate(logs)


def test_a_wild_dig_keeps_mass_and_stays_bounded():
    before = ground(1.0).mass_kg
    own, log = levelled(1.0)
    assert np.isfinite(log).all()
    assert own.mass_kg == pytest.approx(before, rel=1e-12)
    assert 0.005 < own.ruts_m.max() <= ground_profile.DEEPEST_RUT
    assert (np.hypot(log[:, at.LOG_FORCE], log[:, at.LOG_FORCE + 1]) < 4e5).all()
    surface = (own.heights - own.ruts_m)[
        (np.arange(at.GROUND_POINTS) * (len(own.heights) - 1)) // (at.GROUND_POINTS - 1)
    ]
    assert np.abs(log[-1, at.LOG_GROUND :] - surface).max() < 0.05


def test_without_it_the_ground_forgets():
    own, log = levelled(0.0)
    assert not own.ruts_m.any()
    assert np.abs(log - levelled(1.0)[1]).max() > 0.0


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_what_cannot_be_is_refused(value):
    with pytest.raises(ConfigError, match="compaction"):
        dataclasses.replace(load_material("clay"), compaction=value)
