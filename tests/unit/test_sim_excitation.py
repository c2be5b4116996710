"""Ways of moving the levers: what each is for, and where the bucket is."""

import itertools

import numpy as np
import pytest
from scipy import signal

from edp.sim import EXCITATIONS, Scenario, Simulation, load_machine
from edp.sim.excitation.levers import dead_lever, speed_table
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose
from edp.sim.view import view_of

MACHINE = load_machine("M22")


def run(family, seconds, seed=1):
    simulation = Simulation(Scenario(excitation=family, duration_s=seconds, seed=seed, sensor_noise=False))
    simulation.run(round(seconds * 100))
    return simulation


def test_the_families_of_the_design_are_there():
    assert set(EXCITATIONS) >= {
        "isolated",
        "combined",
        "aprbs",
        "reversals",
        "end_stops",
        "grading",
        "dig",
        "broadband",
    }


@pytest.mark.processes
def test_inverse_kinematics_undo_forward_kinematics():
    kinematics = pose.Kinematics(*pack(MACHINE))
    for strokes in np.random.default_rng(0).uniform(0.0, 1.0, (100, 3)):
        np.testing.assert_allclose(kinematics.strokes_at(*kinematics.pose_at(strokes)), strokes, atol=1e-9)
    assert kinematics.strokes_at(20.0, 0.0, 0.0) is None
    assert kinematics.strokes_at(1.0, 0.0, 0.0) is None


def test_a_view_says_where_the_plant_is():
    simulation = run("combined", 3.0)
    view, plant = view_of(simulation.plant), simulation.plant
    np.testing.assert_allclose(view.strokes, plant.strokes, rtol=1e-12)
    np.testing.assert_array_equal(view.angles, plant.state[:3])
    assert (view.tip_x, view.tip_y, view.attitude) == pytest.approx(pose.tip_pose(view.angles, plant.axes))
    assert np.isnan(view.ground)
    assert np.isnan(view.depth)
    assert view.payload_kg == 0.0
    before = plant.strokes
    rows = simulation.run(1)
    np.testing.assert_allclose(rows[0, at.LOG_VELOCITY : at.LOG_VELOCITY + 3], view.speeds, rtol=1e-12)
    np.testing.assert_allclose((plant.strokes - before) * MACHINE.cylinders.stroke * 100, view.speeds, atol=2e-2)


@pytest.mark.long
@pytest.mark.parametrize("family", list(EXCITATIONS))
def test_targets_stay_on_the_lever_and_strokes_near_the_middle(family):
    runs = [run(family, 120.0, seed) for seed in range(2)]
    levers = np.concatenate([r.targets for r in runs])
    assert np.abs(levers).max() <= 1.0
    assert (np.abs(levers).max(axis=0) > 0.2).all()
    strokes = np.concatenate([r.log[:, at.LOG_STROKE : at.LOG_STROKE + 3] for r in runs]) / MACHINE.cylinders.stroke
    assert (np.abs(strokes.mean(axis=0) - 0.5) < 0.27).all(), strokes.mean(axis=0)


def test_steps_take_nine_levels_around_the_dead_band_and_chirps_reach_5_hz():
    levers = run("aprbs", 240.0).targets
    dead = dead_lever(MACHINE)
    values, counts = np.unique(np.round(levers[:, 0], 9), return_counts=True)
    steps = values[counts > 100]
    assert len(steps) == 9
    assert (np.abs(steps[steps != 0]) > 0.9 * dead.min()).all()
    assert np.sum(np.abs(steps) < dead[0].min()) == 3
    turns = np.abs(np.diff(np.sign(np.diff(levers, axis=0)), axis=0)) > 1
    assert max(turns[k : k + 100].sum(axis=0).max() for k in range(0, len(turns), 50)) >= 8


@pytest.mark.long
def test_broadband_commands_are_flat_to_4_hz_and_of_different_courses():
    """Within 10 dB from 0.1 to 4 Hz on every axis, by demands as logs have them; axes are not the same signal."""
    simulation = run("broadband", 120.0, seed=3)
    demand = simulation.log[:, at.LOG_DEMAND : at.LOG_DEMAND + 3]
    frequency, density = signal.welch(demand, fs=100.0, nperseg=1000, axis=0)
    used = density[(frequency >= 0.1) & (frequency <= 4.0)]
    drop = 10.0 * np.log10(used.max(axis=0) / used.min(axis=0))
    assert (drop < 10.0).all(), drop
    beyond = density[frequency > 8.0].max(axis=0)
    assert (10.0 * np.log10(used.min(axis=0) / beyond) > 10.0).all(), "no power is wasted where no valve follows"
    assert np.abs(np.corrcoef(demand.T) - np.eye(3)).max() < 0.2
    courses = simulation.targets[: 12 * 1000].reshape(12, 1000, 3)
    assert np.abs(np.corrcoef(courses[0, :, 0], courses[1, :, 0])[0, 1]) < 0.3


def test_broadband_holds_at_low_rates():
    """At 5 Hz no sine is faster than what the rate shows; the levers still move and stay on the lever."""
    operator = EXCITATIONS["broadband"](np.random.default_rng(0), 5.0, MACHINE)
    view = view_of(Simulation(Scenario()).plant)
    levers = np.concatenate([operator.block(view) for _ in range(120)])
    assert len(levers) == 120
    assert np.abs(levers).max() <= 1.0
    assert levers.std(axis=0).min() > 0.05


def test_grading_draws_straight_lines_at_constant_attitude():
    simulation = Simulation(Scenario(excitation="grading", duration_s=200.0, seed=3))
    operator, errors, turned, travelled = simulation.operator, [], [], 0.0
    while simulation.samples < 12_000:
        simulation.run(5)
        if operator._leg[7] > 0.5 and operator._memory[0] > 1.0:
            view = view_of(simulation.plant)
            line = operator._leg[3:5] - operator._leg[:2]
            normal = np.array([-line[1], line[0]]) / np.hypot(*line)
            errors.append(normal @ (np.array([view.tip_x, view.tip_y]) - operator._leg[:2]))
            turned.append(view.attitude - operator._leg[2])
            travelled += 0.05 * np.hypot(*line) / operator._leg[6]
    assert len(errors) > 1000
    assert travelled > 8.0
    assert np.sqrt(np.mean(np.square(errors))) < 0.08
    assert np.sqrt(np.mean(np.square(turned))) < np.deg2rad(4)


def test_a_dig_goes_through_its_phases_and_mimes_depth_in_free_air():
    simulation = Simulation(Scenario(excitation="dig", duration_s=300.0, seed=2))
    operator, phases, low, high = simulation.operator, [], [], []
    while simulation.samples < 12_000:
        simulation.run(5)
        phases.append(operator._phase)
        view = view_of(simulation.plant)
        if operator._phase == 2 and operator._memory[0] > 0.7:
            low.append(operator._surface - view.tip_y)
        if operator._phase == 4:
            high.append(view.tip_y - operator._surface)
    order = [a for a, b in itertools.pairwise(phases) if a != b]
    assert order[:10] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]
    assert 0.02 < np.mean(low) < 0.5
    assert np.mean(high) > 0.5


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_a_dig_in_soil_fills_the_bucket_and_empties_it_again_and_again(machine):
    simulation = Simulation(
        Scenario(machine=machine, excitation="dig", material="sandy_loam", duration_s=120.0, seed=1)
    )
    load = simulation.run(12_000)[:, at.LOG_PAYLOAD]
    emptied = (load[:-1] > 50) & (load[1:] <= 50)
    assert emptied.sum() >= 4
    assert load.max() > 300


def test_measured_speeds_rise_with_the_lever_from_the_end_of_the_dead_band():
    levers, speeds = speed_table(MACHINE)
    assert levers.shape == speeds.shape == (3, 2, 6)
    assert (np.diff(levers) > 0).all()
    assert (np.diff(speeds) > 0).all()
    np.testing.assert_array_equal(levers[:, :, 0], dead_lever(MACHINE))
    assert (speeds[:, :, 0] == 0).all()
    assert (speeds[:, :, -1] > 0.15).all()


@pytest.mark.parametrize(("machine", "material"), [("M22", "sandy_loam"), ("C14", "clay")])
def test_dig_cycles_in_soil_fill_the_bucket_and_empty_it(machine, material):
    simulation = Simulation(Scenario(machine, "dig", 300.0, seed=2, material=material))
    ends = []
    for _ in range(900):
        before, load = simulation.operator._phase, simulation.plant.payload_kg
        simulation.run(10)
        if simulation.operator._phase != before:
            ends.append((before, load))
    cycles = [load for phase, load in ends if phase == 4]
    assert len(cycles) >= 3
    full = 1700.0 * simulation.machine.bucket.capacity
    assert max(load for phase, load in ends if phase == 2) > 0.3 * full
    assert min(load for phase, load in ends if phase == 0) < 0.2 * full


def test_grading_over_ground_works_at_its_surface():
    simulation = Simulation(Scenario(excitation="grading", duration_s=200.0, seed=1, material="sandy_loam"))
    simulation.run(9000)
    touching = simulation.log[:, at.LOG_EVENTS + at.SOIL_CONTACT]
    assert 0.2 < touching.mean() < 0.98
    assert np.isfinite(simulation.recording().values).all()
