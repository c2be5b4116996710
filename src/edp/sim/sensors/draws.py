"""Random numbers of sensors and bus for a recording, sampled before the start: one row per sample."""

from __future__ import annotations

import binascii
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.sensors import alterations, can, chain, filters, transducers

Array = NDArray[np.float64]
ECUS = ("joints", "pressures", "valves")
"""Names of the control units that send on the bus: joint rates, cylinder pressures and pilot demands."""


@dataclass(frozen=True, eq=False)
class Instance:
    """Properties that differ between machines of one type and are constant over recordings.

    Attributes:
        pressure_offset: offsets of the six cylinder pressures, as fractions of full scale.
        phase: time offset between the clocks of each of `ECUS` and of the logger, as a fraction of the frame period.
        latency_s: mean latency of each of `ECUS`, s.
    """

    pressure_offset: Array
    phase: Array
    latency_s: Array


def instance_of(machine: Machine) -> Instance:
    """Return the fixed instance of a machine, generated from its name and ``instance_seed``."""
    own = machine.sensors
    # crc32, since hash() of a text differs from process to process.
    rng = np.random.default_rng([binascii.crc32(machine.name.encode()), int(own.instance_seed)])
    return Instance(
        rng.choice([-1.0, 1.0], 6) * rng.uniform(*own.pressure_offset, 6),
        rng.uniform(0.0, 1.0, len(ECUS)),
        rng.uniform(*own.can_latency, len(ECUS)),
    )


def draw(machine: Machine, samples: int, rate_hz: float, rng: np.random.Generator | None) -> Array:
    """Return the random values of a recording, shape (samples, chain.DRAWS); zeros without `rng`.

    Args:
        machine: machine with the ``[sensors]`` to use.
        samples: number of samples.
        rate_hz: sample rate, Hz.
        rng: source of noise, bias, jitter and losses of this recording.
    """
    drawn = np.zeros((samples, chain.DRAWS))
    if rng is None:
        drawn[:, : len(ECUS)] = np.arange(samples)[:, None]
        return drawn
    own = machine.sensors
    # The order of the draws is fixed: another one would give other recordings for the same seed.
    joints, transmitters, valves = _bus(machine, samples, rate_hz, rng)
    for column, frames in ((chain.AT_JOINTS, joints), (chain.AT_PRESSURES, transmitters), (chain.AT_VALVES, valves)):
        # What lies before the first sample has its value.
        drawn[:, column] = np.maximum(frames.positions[frames.seen], 0.0)
    shape = (len(joints.positions), 3)
    # Without a bus each sample is a frame.
    frame_s = own.can_period or 1.0 / rate_hz
    drift, noise = rng.spawn(2)
    # Files state the walk per root of a minute.
    # Generators of their own: what has no size need not be drawn.
    if own.joint_bias_walk_deg > 0.0:
        bias = transducers.random_walk(shape, frame_s, np.deg2rad(own.joint_bias_walk_deg) / np.sqrt(60.0), drift)
        drawn[:, chain.RATE_BIAS : chain.RATE_BIAS + 3] = bias[joints.seen]
    if own.joint_rate_deg > 0.0:
        error = noise.normal(0.0, np.deg2rad(own.joint_rate_deg), shape)
        drawn[:, chain.RATE_ERROR : chain.RATE_ERROR + 3] = error[joints.seen]
    drawn[:, chain.VELOCITY_ERROR : chain.VELOCITY_ERROR + 3] = rng.normal(0.0, own.velocity, shape)[joints.seen]
    pressure_error = rng.normal(0.0, own.pressure, (len(transmitters.positions), 6))
    drawn[:, chain.PRESSURE_ERROR :] = pressure_error[transmitters.seen]
    return drawn


def depth(drawn: Array) -> int:
    """Return how many ticks back the oldest value is read that is shown, and the tick itself."""
    late = np.arange(len(drawn))[:, None] - np.floor(drawn[:, : len(ECUS)])
    return int(late.max()) + 1


def _bus(machine: Machine, samples: int, rate_hz: float, rng: np.random.Generator) -> list[can.Frames]:
    """Return the frames of each of `ECUS`, with independent random values."""
    own, instance = machine.sensors, instance_of(machine)
    bus = can.Bus(own.can_period, own.can_latency, own.can_jitter, own.can_loss)
    # Each ECU has its own generator, so that one ECU does not change the noise of the others.
    each = zip(instance.phase, instance.latency_s, rng.spawn(len(ECUS)), strict=True)
    return [can.frames(samples, rate_hz, bus, phase, latency, child) for phase, latency, child in each]


def pack_sensors(machine: Machine, rate_hz: float, noisy: bool, faults: Array | None = None) -> chain.Setup:
    """Return the arrays of the sensor chain: parameters, `axes` and `plant` of the machine, and the table of faults.

    As built, since payload, oil and faults change the plant's own.

    Args:
        machine: machine with the ``[sensors]`` to use.
        rate_hz: rate of the log.
        noisy: False for the truth.
        faults: sensor faults, one row each; see `edp.sim.sensors.alterations`.
    """
    own, step_s = machine.sensors, 1.0 / rate_hz
    numbers = np.zeros(chain.SENSOR_NUMBERS)
    numbers[chain.NOISY], numbers[chain.STEP_S], numbers[chain.PILOT_FULL] = (
        noisy,
        step_s,
        machine.valves.pilot_pressure,
    )
    numbers[chain.DERIVATIVE : chain.DERIVATIVE + 5] = filters.derivative_numbers(own.acceleration_bandwidth, rate_hz)
    numbers[chain.LAGGED] = own.pressure_lag > 0.0
    numbers[chain.LAG : chain.LAG + 3] = transducers.lag(own.pressure_lag, step_s)
    numbers[chain.RANGE], numbers[chain.DRIFT] = own.pressure_range, own.pressure_drift
    numbers[chain.QUANTUM] = own.pressure_range / 2.0**own.pressure_bits if own.pressure_bits > 0 else 0.0
    numbers[chain.ANGLE_QUANTUM] = np.deg2rad(own.angle_quantum_deg)
    numbers[chain.LEVERED] = own.angle_quantum_deg > 0.0 or own.joint_rate_deg > 0.0 or own.joint_bias_walk_deg > 0.0
    numbers[chain.PLAYING] = any(own.pin_backlash)
    numbers[chain.PLAY : chain.PLAY + 3] = own.pin_backlash
    numbers[chain.OFFSET : chain.OFFSET + 6] = instance_of(machine).pressure_offset
    numbers[chain.PRESSURES_FROM] = at.HEAD if own.pressure_at == "cylinder" else at.LOG_PORT
    axes, plant = pack(machine)
    return numbers, axes, plant, np.zeros((0, alterations.COLUMNS)) if faults is None else faults
