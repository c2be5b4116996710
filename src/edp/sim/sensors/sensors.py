"""From plant truth to logged signals: what a machine's sensors and its bus make of them (its ``[sensors]``)."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pins
from edp.sim.sensors import can, filters, transducers

Array = NDArray[np.float64]
DERIVATIVE_DAMPING = 0.7
"""Share of critical: nearly flat up to the bandwidth, with hardly any overshoot of the acceleration."""
ECUS = ("joints", "pressures", "valves")
"""Senders on the bus: rates of the joints, cylinder pressures, and pilot demands."""
REFERENCE_TEMPERATURE = 313.15
"""Oil temperature in K at which pressure transmitters are adjusted (40 degC)."""


@dataclass(frozen=True, eq=False)
class Instance:
    """What differs between two machines of one type and stays the same from recording to recording.

    Attributes:
        pressure_offset: offsets of the six cylinder pressures as a share of full scale.
        phase: clock of each of `ECUS` against the logger's, as a share of the frame period.
        latency_s: usual latency of each of them.
    """

    pressure_offset: Array
    phase: Array
    latency_s: Array


def instance_of(machine: Machine) -> Instance:
    """The fixed instance of a machine, drawn from its name and ``instance_seed``."""
    own = machine.sensors
    # crc32, since hash() of a text differs from process to process.
    rng = np.random.default_rng([zlib.crc32(machine.name.encode()), int(own.instance_seed)])
    return Instance(
        rng.choice([-1.0, 1.0], 6) * rng.uniform(*own.pressure_offset, 6),
        rng.uniform(0.0, 1.0, len(ECUS)),
        rng.uniform(*own.can_latency, len(ECUS)),
    )


def filtered_derivative(values: Array, bandwidth_hz: float, rate_hz: float) -> Array:
    """Causal derivative along time, w^2 s / (s^2 + 2 zeta w s + w^2) by the bilinear rule, shape ``(time, channel)``.

    The filter starts at rest at the first value.
    """
    # Below half of the rate, where the bilinear rule warps frequencies.
    omega = 2.0 * np.pi * min(bandwidth_hz, 0.4 * rate_hz)
    return filters.lfilter(*filters.bilinear_derivative(omega, DERIVATIVE_DAMPING, rate_hz), values - values[:1])


def pilot_demands(demands: Array, full_pressure: float) -> Array:
    """Signed spool demands, shape (time, 6), to the 12 one-sided pilot pressures of Table A.1 in Pa.

    Order: extend and retract of boom, arm and bucket, then the same for their conflux spools.
    """
    sides = np.stack((np.maximum(demands, 0.0), np.maximum(-demands, 0.0)), axis=2)
    return full_pressure * sides.reshape(len(demands), 12)


def measured_signals(
    log: Array,
    machine: Machine,
    rate_hz: float,
    rng: np.random.Generator | None,
    oil_temperature: Array | None = None,
) -> Array:
    """The 24 signals of Table A.1 in its order, SI units, shape (time, 24); the truth when `rng` is None.

    No sample depends on a later one. Acceleration is the filtered derivative of the measured velocity.

    Args:
        log: rows of the plant.
        machine: whose ``[sensors]`` holds.
        rate_hz: rate of the log.
        rng: source of noise, bias, jitter and losses of this recording.
        oil_temperature: in K, shape (time,), for the drift of the pressures; default: the machine's constant.
    """
    velocity = log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    pressures = log[:, at.HEAD : at.HEAD + 6]
    demands = log[:, at.LOG_DEMAND : at.LOG_DEMAND + at.SPOOLS]
    pilots = pilot_demands(demands, machine.valves.pilot_pressure)
    if rng is not None:
        if oil_temperature is None:
            oil_temperature = np.full(len(log), machine.oil.temperature + 273.15)
        joints, transmitters, valves = _bus(machine, len(log), rate_hz, rng)
        velocity = joints.hold(_velocity(log, machine, rate_hz, joints, rng))
        pressures = transmitters.hold(_pressures(pressures, oil_temperature, machine, rate_hz, transmitters, rng))
        pilots = valves.hold(valves.take(pilots))
    acceleration = filtered_derivative(velocity, machine.sensors.acceleration_bandwidth, rate_hz)
    return np.concatenate((velocity, acceleration, pressures, pilots), axis=1)


def _bus(machine: Machine, samples: int, rate_hz: float, rng: np.random.Generator) -> list[can.Frames]:
    """Frames of each of `ECUS`, with random numbers of their own."""
    own, instance = machine.sensors, instance_of(machine)
    bus = can.Bus(own.can_period, own.can_latency, own.can_jitter, own.can_loss)
    # A generator each: what one ECU draws does not move the noise of the others.
    each = zip(instance.phase, instance.latency_s, rng.spawn(len(ECUS)), strict=True)
    return [can.frames(samples, rate_hz, bus, phase, latency, child) for phase, latency, child in each]


def _velocity(log: Array, machine: Machine, rate_hz: float, frames: can.Frames, rng: np.random.Generator) -> Array:
    """Cylinder velocities that the joints' ECU sends: v = J(measured angle) * measured rate, shape (frame, 3)."""
    own = machine.sensors
    step_s = 1.0 / rate_hz
    axes, plant = pack(machine)
    play = pins.play_velocity(*pins.loads(log, axes, plant), np.array(own.pin_backlash), step_s)
    velocity = frames.take(log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3] + play)
    angles, rates = frames.take(log[:, at.PSI : at.PSI + 3]), frames.take(log[:, at.RATE : at.RATE + 3])
    # Without a bus each sample is a frame.
    frame_s = own.can_period or step_s
    drift, noise = rng.spawn(2)
    # Files state the walk per root of a minute.
    error = transducers.random_walk(rates.shape, frame_s, np.deg2rad(own.joint_bias_walk_deg) / np.sqrt(60.0), drift)
    error += noise.normal(0.0, np.deg2rad(own.joint_rate_deg), rates.shape)
    lever = pins.lever_arms(transducers.quantised(angles, np.deg2rad(own.angle_quantum_deg)), plant)
    # The play is in the velocity already; added is what angle quantum and rate error change of J times rate.
    velocity = velocity + (lever - pins.lever_arms(angles, plant)) * rates + lever * error
    return velocity + rng.normal(0.0, own.velocity, velocity.shape)


def _pressures(
    truth: Array, temperature: Array, machine: Machine, rate_hz: float, frames: can.Frames, rng: np.random.Generator
) -> Array:
    """Cylinder pressures that the transmitters' ECU sends, shape (frame, 6)."""
    own = machine.sensors
    drift = own.pressure_drift * (frames.take(temperature[:, None]) - REFERENCE_TEMPERATURE)
    values = frames.take(transducers.lagged(truth, own.pressure_lag, 1.0 / rate_hz))
    values = values + own.pressure_range * (instance_of(machine).pressure_offset + drift)
    values = values + rng.normal(0.0, own.pressure, values.shape)
    quantum = own.pressure_range / 2.0**own.pressure_bits if own.pressure_bits > 0 else 0.0
    # In the order of a transmitter: the converter sees what the range has cut.
    return transducers.quantised(transducers.limited(values, own.pressure_range), quantum)


def truth_signals(log: Array) -> dict[str, Array]:
    """Noise-free further signals by the names of `EXTRA_CHANNELS` and, in soil, of `GROUND_CHANNELS`."""
    columns: dict[str, Array] = {}
    for m in range(2):
        columns[f"PumpPressure_{m + 1}"] = log[:, at.PUMP + m]
        columns[f"PumpDisplacement_{m + 1}"] = log[:, at.DISPLACEMENT + m]
    for i in range(at.AXES):
        columns[f"CylStroke_{i + 1}"] = log[:, at.LOG_STROKE + i]
        columns[f"JointAngle_{i + 1}"] = log[:, at.PSI + i]
        columns[f"JointVel_{i + 1}"] = log[:, at.RATE + i]
    for j in range(at.SPOOLS):
        columns[f"SpoolPos_{j + 1}"] = log[:, at.LOG_SPOOL + j]
    one_each = ("TipX", "TipY", "TipAngle", "TipForceX", "TipForceY", "Payload", "OilTemperature")
    events = ("Relief", "Cavitation", "Regeneration", "PowerLimit", "SoilContact")
    for n, name in enumerate((*one_each, *(f"Event_{event}" for event in events))):
        columns[name] = log[:, at.LOG_TIP + n]
    columns["OilTemperature"] = columns["OilTemperature"] + 273.15
    for k in range(log.shape[1] - at.LOG_GROUND):
        columns[f"Ground_{k:02d}"] = log[:, at.LOG_GROUND + k]
    return columns
