"""The chain of sensors tick by tick, against one in NumPy and SciPy over whole recordings."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from edp.sim import Scenario, Simulation, load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import pins
from edp.sim.sensors import can, chain, draws, sensors

MACHINES = ("M22", "C14")


@pytest.fixture(scope="module")
def logs():
    """Four seconds of each machine at three rates, with the machine."""
    logs = {}
    for name in MACHINES:
        for rate in (50.0, 100.0, 200.0):
            simulation = Simulation(Scenario(machine=name, duration_s=4.0, rate_hz=rate, seed=3))
            logs[name, rate] = simulation.run(round(4.0 * rate))
    return logs


def take(frames, values):
    """Values at the instants of the frames, linear between samples, then the newest that had arrived."""
    at_frames = np.stack([np.interp(frames.positions, np.arange(len(values)), column) for column in values.T], axis=1)
    return at_frames, lambda sent: sent[frames.seen]


def rounded(values, quantum):
    return np.round(values / quantum) * quantum if quantum > 0 else values


def plain_velocity(log, machine, rate, frames, rng):
    own, step_s = machine.sensors, 1 / rate
    axes, plant = pack(machine)
    play = pins.play_velocity(*pins.loads(log, axes, plant), np.array(own.pin_backlash), step_s)
    velocity, hold = take(frames, log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3] + play)
    angles, rates = take(frames, log[:, at.PSI : at.PSI + 3])[0], take(frames, log[:, at.RATE : at.RATE + 3])[0]
    drift, noise = rng.spawn(2)
    per_frame = np.deg2rad(own.joint_bias_walk_deg) / np.sqrt(60) * np.sqrt(own.can_period or step_s)
    steps = drift.normal(0, per_frame, rates.shape)
    steps[0] = 0
    error = np.cumsum(steps, axis=0) + noise.normal(0, np.deg2rad(own.joint_rate_deg), rates.shape)
    lever = pins.lever_arms(rounded(angles, np.deg2rad(own.angle_quantum_deg)), plant)
    velocity = velocity + (lever - pins.lever_arms(angles, plant)) * rates + lever * error
    return hold(velocity + rng.normal(0, own.velocity, velocity.shape))


def plain_pressures(log, machine, rate, frames, rng, kelvin):
    own, step_s = machine.sensors, 1 / rate
    truth = log[:, at.HEAD : at.HEAD + 6]
    if own.pressure_lag:
        decay = np.exp(-step_s / own.pressure_lag)
        new = 1 - own.pressure_lag * (1 - decay) / step_s
        truth = truth[0] + lfilter([new, 1 - decay - new], [1, -decay], truth - truth[0], axis=0)
    sent, hold = take(frames, truth)
    drift = own.pressure_drift * (take(frames, kelvin[:, None])[0] - 313.15)
    sent = sent + own.pressure_range * (draws.instance_of(machine).pressure_offset + drift)
    sent = sent + rng.normal(0, own.pressure, sent.shape)
    if own.pressure_range:
        sent = np.clip(sent, 0, own.pressure_range)
    return hold(rounded(sent, own.pressure_range / 2**own.pressure_bits if own.pressure_bits else 0))


def plain_chain(log, machine, rate, rng):
    """The 24 signals by whole columns, in the order of draws that recordings have always had."""
    own, instance = machine.sensors, draws.instance_of(machine)
    kelvin = log[:, at.LOG_OIL] + 273.15
    demands = log[:, at.LOG_DEMAND : at.LOG_DEMAND + 6]
    sides = np.stack((np.maximum(demands, 0), np.maximum(-demands, 0)), axis=2)
    pilots = machine.valves.pilot_pressure * sides.reshape(-1, 12)
    velocity, pressures = log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3], log[:, at.HEAD : at.HEAD + 6]
    if rng is not None:
        bus = can.Bus(own.can_period, own.can_latency, own.can_jitter, own.can_loss)
        each = zip(instance.phase, instance.latency_s, rng.spawn(3), strict=True)
        ecus = [can.frames(len(log), rate, bus, phase, late, child) for phase, late, child in each]
        velocity = plain_velocity(log, machine, rate, ecus[0], rng)
        pressures = plain_pressures(log, machine, rate, ecus[1], rng, kelvin)
        sent, hold = take(ecus[2], pilots)
        pilots = hold(sent)
    omega, k = 2 * np.pi * min(own.acceleration_bandwidth, 0.4 * rate), 2 * rate
    scale = k * k + 1.4 * omega * k + omega * omega
    b = np.array([1, 0, -1]) * omega**2 * k / scale
    a = [1, 2 * (omega**2 - k * k) / scale, (k * k - 1.4 * omega * k + omega**2) / scale]
    acceleration = lfilter(b, a, velocity - velocity[0], axis=0)
    return np.concatenate((velocity, acceleration, pressures, pilots), axis=1)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0])
@pytest.mark.parametrize("name", MACHINES)
def test_recordings_are_those_of_whole_columns(logs, name, rate, noisy):
    log, machine = logs[name, rate], load_machine(name)
    for seed in range(3):
        first, second = (np.random.default_rng(seed) if noisy else None for _ in range(2))
        shown = sensors.measure_signals(log, machine, rate, first, log[:, at.LOG_OIL] + 273.15)
        plain = plain_chain(log, machine, rate, second)
        # a pilot that is never used stays at 0
        size = np.maximum(np.abs(plain).max(axis=0), 1e-3)
        np.testing.assert_allclose(shown / size, plain / size, atol=1e-12)
        if noisy:
            # both have drawn as much
            assert first.random() == second.random()


@settings(max_examples=20, deadline=None)
@given(
    name=st.sampled_from(MACHINES),
    rate=st.sampled_from((50.0, 100.0, 200.0)),
    noisy=st.booleans(),
    seed=st.integers(0, 2**32),
    length=st.integers(2, 200),
)
def test_a_tick_at_a_time_gives_the_bits_of_the_recording(logs, name, rate, noisy, seed, length):
    log, machine = logs[name, rate][:length], load_machine(name)
    kelvin = log[:, at.LOG_OIL] + 273.15
    whole = sensors.measure_signals(log, machine, rate, np.random.default_rng(seed) if noisy else None, kelvin)
    drawn = draws.draw(machine, length, rate, np.random.default_rng(seed) if noisy else None)
    setup, state = draws.pack_sensors(machine, rate, noisy), chain.new_state(draws.depth(drawn))
    for k in range(length):
        shown = np.full(chain.SENSED, np.nan)
        # a copy a tick: nothing may be read again later
        chain.sense(log[k : k + 1].copy(), kelvin[k], k, drawn[k].copy(), setup, state, shown)
        np.testing.assert_array_equal(shown[: chain.MEASURED], whole[k])


def test_the_memory_of_the_sensors_is_as_deep_as_the_latest_frame():
    machine = load_machine("C14")
    late = dataclasses.replace(machine.sensors, can_latency=(0.085, 0.085), can_jitter=0.0, can_loss=0.0)
    drawn = draws.draw(dataclasses.replace(machine, sensors=late), 500, 100.0, np.random.default_rng(0))
    # 85 ms of latency and up to 10 ms of waiting
    assert 9 <= draws.depth(drawn) <= 11
    assert draws.depth(draws.draw(load_machine("M22"), 500, 100.0, np.random.default_rng(0))) == 1
