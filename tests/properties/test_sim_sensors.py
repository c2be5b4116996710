"""Each effect of sensors and bus by a property of its own, and the chain as a whole by causality."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.layout import LOG_COLUMNS, LOG_VELOCITY
from edp.sim.physics import dynamics, pins
from edp.sim.physics.plant import Plant
from edp.sim.sensors import can, draws, sensors, transducers

BUS = can.Bus(period=0.010, latency=(0.002, 0.012), jitter=1.5e-3, loss=0.02)
FULL = {
    "velocity": 0.0,
    "pressure": 1.5e4,
    "joint_rate_deg": 0.07,
    "joint_bias_walk_deg": 0.02,
    "angle_quantum_deg": 0.01,
    "pin_backlash": (1.5e-3, 1.5e-3, 2e-3),
    "pressure_range": 500e5,
    "pressure_offset": (0.0025, 0.005),
    "pressure_bits": 12,
    "pressure_lag": 0.002,
    "pressure_drift": 1e-4,
    "can_period": 0.010,
    "can_latency": (0.002, 0.012),
    "can_jitter": 1.5e-3,
    "can_loss": 1e-2,
    "instance_seed": 1,
}


def machine_with(**sizes):
    machine = load_machine("M22")
    return dataclasses.replace(machine, sensors=dataclasses.replace(machine.sensors, **sizes))


def quantised(values, quantum):
    return np.array([transducers.quantised(value, quantum) for value in values.ravel()]).reshape(values.shape)


@pytest.fixture(scope="module")
def log():
    """Four seconds of all axes moving to and fro."""
    plant = Plant(load_machine("M22"), np.array([0.5, 0.5, 0.5]))
    time = np.arange(400)[:, None] / 100
    return plant.run(np.sin(2 * np.pi * (time * [0.5, 0.8, 1.1])))


@settings(max_examples=25, deadline=None)
@given(phase=st.floats(0.0, 1.0), latency=st.floats(0.002, 0.012), seed=st.integers(0, 99))
def test_frames_arrive_in_order_within_their_latency_and_none_is_seen_early(phase, latency, seed):
    sent = can.frames(2000, 100.0, BUS, phase, latency, np.random.default_rng(seed))
    arrived = np.isfinite(sent.arrivals)
    late = (sent.arrivals - sent.positions)[arrived] / 100.0
    assert late.min() >= BUS.latency[0] - 1e-12
    assert late.max() <= BUS.latency[1] + 1e-12
    assert (np.diff(sent.arrivals[arrived]) >= -1e-9).all()
    assert arrived[sent.seen].all()
    assert (sent.arrivals[sent.seen] <= np.arange(2000)).all()
    # the newest of those that had arrived
    later = np.searchsorted(sent.arrivals[arrived], np.arange(2000), side="right")
    np.testing.assert_array_equal(sent.seen, np.flatnonzero(arrived)[later - 1])


def test_frames_are_lost_at_the_stated_share_and_the_last_value_holds():
    sent = can.frames(200_000, 100.0, BUS, 0.3, 0.006, np.random.default_rng(1))
    assert np.isinf(sent.arrivals).mean() == pytest.approx(BUS.loss, rel=0.1)
    values = np.arange(len(sent.positions))[sent.seen]
    assert (np.diff(values) == 0).mean() >= 0.8 * BUS.loss
    assert (np.diff(values) >= 0).all()


def test_without_a_bus_every_sample_is_its_own():
    plain = can.frames(50, 100.0, dataclasses.replace(BUS, period=0.0), 0.5, 0.01, np.random.default_rng(0))
    np.testing.assert_array_equal(plain.positions[plain.seen], np.arange(50))


def test_a_ramp_on_the_bus_is_late_by_latency_and_waiting():
    rows = np.zeros((1000, LOG_COLUMNS))
    rows[:, LOG_VELOCITY : LOG_VELOCITY + 3] = rows[:, at.HEAD : at.HEAD + 6] = np.arange(1000.0)[:, None]
    rows[:, at.LOG_DEMAND : at.LOG_DEMAND + 6] = np.arange(1000.0)[:, None] * [1, -1, 1, -1, 1, -1]
    machine = machine_with(velocity=0.0, pressure=0.0, can_period=0.010, can_latency=(0.004, 0.004))
    shown = sensors.measure_signals(rows, machine, 100.0, np.random.default_rng(0))
    full = machine.valves.pilot_pressure
    for columns, ecu, scale in ((slice(0, 3), 0, 1.0), (slice(6, 12), 1, 1.0), ([12, 15, 16, 19, 20, 23], 2, full)):
        phase = draws.instance_of(machine).phase[ecu]
        # taken at the phase, there 0.4 ticks later, shown at the next tick
        late = np.ceil(phase + 0.4) - phase
        ramp = np.arange(1000.0)[:, None] - shown[:, columns] / scale
        np.testing.assert_allclose(ramp[5:], late, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(quantum=st.floats(1e-6, 1e3), seed=st.integers(0, 99))
def test_quanta(quantum, seed):
    values = np.random.default_rng(seed).normal(0, 50 * quantum, (200, 3))
    shown = quantised(values, quantum)
    assert np.abs(shown - values).max() <= quantum / 2 * (1 + 1e-9)
    np.testing.assert_allclose(shown / quantum, np.round(shown / quantum), atol=1e-6)
    np.testing.assert_array_equal(quantised(values, 0.0), values)


def test_a_random_walk_grows_with_the_root_of_time_whatever_the_step():
    for step in (0.01, 0.1):
        walks = transducers.random_walk((round(60 / step) + 1, 2000), step, 0.3, np.random.default_rng(5))
        assert not walks[0].any()
        assert walks[-1].std() == pytest.approx(0.3 * np.sqrt(60), rel=0.06)


def test_the_lag_is_that_of_a_ramp_and_rests_at_the_first_value():
    machine = machine_with(pressure=0.0, pressure_lag=0.02)
    rows = np.zeros((400, LOG_COLUMNS))
    rows[:, at.HEAD : at.HEAD + 3] = np.arange(400)[:, None] / 100
    rows[:, at.ROD : at.ROD + 3] = 7.0
    shown = sensors.measure_signals(rows, machine, 100.0, np.random.default_rng(0))[:, 6:12]
    np.testing.assert_allclose(shown[50:, :3], rows[50:, at.HEAD : at.HEAD + 3] - 0.02, atol=1e-9)
    np.testing.assert_allclose(shown[:, 3:], 7.0, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 99), width=st.floats(1e-4, 5e-3))
def test_the_way_within_the_play_is_the_play_and_only_forces_that_turn_cross_it(seed, width):
    rng = np.random.default_rng(seed)
    force = np.cumsum(rng.normal(0, 5e3, (3000, 3)), axis=0)
    force[:, 2] += 5e6
    mass = np.full((3000, 3), 2e4)
    way = np.cumsum(pins.play_velocity(force, mass, np.full(3, width), 0.01), axis=0) * 0.01
    assert np.ptp(way, axis=0).max() <= width * (1 + 1e-9)
    assert not way[:, 2].any()
    assert not pins.play_velocity(force, mass, np.zeros(3), 0.01).any()


def test_the_play_is_crossed_by_the_force_that_turned():
    force = np.full((200, 1), -4e4)
    force[:100] = 4e4
    speed = pins.play_velocity(force, np.full((200, 1), 2e4), np.array([2e-3]), 0.01)[:, 0]
    assert not speed[:100].any()
    assert (speed >= 0.0).all()  # the joint had lain behind, now it runs ahead
    assert speed.sum() * 0.01 == pytest.approx(2e-3)
    # the grease lets it go at no more than 40 kN / 4e5 N s/m = 100 mm/s
    assert np.count_nonzero(speed) == pytest.approx(7, abs=2)
    assert speed.max() < 0.1


def test_force_through_the_pins_holds_the_arms_at_rest():
    plant = Plant(load_machine("M22"), np.array([0.5, 0.4, 0.6]))
    rows = plant.run(np.zeros((500, 3)))
    force, mass = pins.loads(rows, plant.axes, plant.plant)
    psi, load = rows[-1, at.PSI : at.RATE], np.zeros(3)
    dynamics.gravity_torque(psi, plant.axes, plant.plant[at.GRAVITY], load)
    np.testing.assert_allclose(force[-1], load / pins.lever_arms(psi[None], plant.plant)[0], rtol=2e-3)
    assert (mass[-1] > [5e4, 5e3, 5e2]).all()
    assert (np.diff(mass[-1]) < 0).all()


def test_transmitters_stay_in_range_on_the_grid_of_their_bits_with_the_offset_of_the_instance():
    machine = machine_with(**{**FULL, "can_period": 0.0, "pressure": 0.0, "pressure_drift": 0.0})
    instance = draws.instance_of(machine)
    size = np.abs(instance.pressure_offset)
    assert ((size >= 0.0025) & (size <= 0.005)).all()
    rows = np.zeros((300, LOG_COLUMNS))
    rows[:, at.HEAD : at.HEAD + 6] = np.linspace(0, 600e5, 300)[:, None]
    shown = sensors.measure_signals(rows, machine, 100.0, np.random.default_rng(0))[:, 6:12]
    assert shown.min() >= 0.0
    assert shown.max() <= 500e5
    quantum = 500e5 / 4096
    np.testing.assert_allclose(shown / quantum, np.round(shown / quantum), atol=1e-6)
    middle = slice(50, 200)
    truth = rows[middle, at.HEAD : at.HEAD + 6] - 600e5 / 299 * 0.2  # 2 ms of the ramp
    np.testing.assert_allclose(shown[middle] - truth, np.tile(500e5 * instance.pressure_offset, (150, 1)), atol=quantum)


def test_pressures_drift_with_the_oil():
    machine = machine_with(**{**FULL, "can_period": 0.0, "pressure": 0.0, "pressure_bits": 0})
    rows = np.zeros((100, LOG_COLUMNS))
    rows[:, at.HEAD : at.HEAD + 6] = 100e5
    at_40, at_60 = (
        sensors.measure_signals(rows, machine, 100.0, np.random.default_rng(0), np.full(100, kelvin))[:, 6:12]
        for kelvin in (313.15, 333.15)
    )
    np.testing.assert_allclose(at_60 - at_40, 20 * 1e-4 * 500e5)


def test_joint_rate_error_is_scaled_by_the_lever_arm(log):
    machine = machine_with(velocity=0.0, joint_rate_deg=0.07)
    levers = pins.lever_arms(log[:, at.PSI : at.PSI + 3], Plant(machine, np.full(3, 0.5)).plant)
    truth = log[:, LOG_VELOCITY : LOG_VELOCITY + 3]
    np.testing.assert_allclose(levers * log[:, at.RATE : at.RATE + 3], truth, atol=1e-12)
    error = sensors.measure_signals(log, machine, 100.0, np.random.default_rng(3))[:, :3] - truth
    assert (error / levers).std() == pytest.approx(np.deg2rad(0.07), rel=0.1)
    assert 0.5e-3 < error[:, 0].std() < 1.5e-3


@pytest.mark.parametrize("cut", [137, 300])
def test_no_sample_depends_on_a_later_one(log, cut):
    machine = machine_with(**FULL)
    whole = sensors.measure_signals(log, machine, 100.0, np.random.default_rng(4))
    other = log.copy()
    other[cut:] = log[cut - 1]
    other[cut:, LOG_VELOCITY:] += 1.0
    changed = sensors.measure_signals(other, machine, 100.0, np.random.default_rng(4))
    np.testing.assert_array_equal(changed[:cut], whole[:cut])
    assert (changed[cut + 5 :] != whole[cut + 5 :]).any()


def test_full_sensors_stay_near_the_truth_and_the_instance_is_fixed(log):
    machine = machine_with(**FULL)
    first, again = (sensors.measure_signals(log, machine, 100.0, np.random.default_rng(s)) for s in (4, 4))
    np.testing.assert_array_equal(first, again)
    other = sensors.measure_signals(log, machine, 100.0, np.random.default_rng(5))
    assert (other[:, :12] != first[:, :12]).any()
    truth = log[:, at.HEAD : at.HEAD + 6]
    means = [(shown[:, 6:12] - truth).mean(axis=0) for shown in (first, other)]
    np.testing.assert_allclose(means[0], means[1], atol=0.2e5)
    second = draws.instance_of(machine_with(**{**FULL, "instance_seed": 2}))
    assert (second.phase != draws.instance_of(machine).phase).all()
    assert np.isfinite(first).all()
