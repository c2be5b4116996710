"""From plant truth to logged signals: white sensor noise and a causal, filtered acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from edp.sim import layout as at
from edp.sim import plant as plant_module
from edp.sim.machine import Machine

Array = NDArray[np.float64]
DERIVATIVE_DAMPING = 0.7


def filtered_derivative(values: Array, bandwidth_hz: float, rate_hz: float) -> Array:
    """Causal derivative along time, w^2 s / (s^2 + 2 zeta w s + w^2) by the bilinear rule, shape ``(time, channel)``.

    The filter starts at rest at the first value.
    """
    omega = 2.0 * np.pi * min(bandwidth_hz, 0.4 * rate_hz)
    b, a = signal.bilinear([omega**2, 0.0], [1.0, 2.0 * DERIVATIVE_DAMPING * omega, omega**2], fs=rate_hz)
    return np.asarray(signal.lfilter(b, a, values - values[:1], axis=0))


def pilot_demands(demands: Array, full_pressure: float) -> Array:
    """Signed spool demands, shape (time, 6), to the 12 one-sided pilot pressures of Table A.1 in Pa.

    Order: extend and retract of boom, arm and bucket, then the same for their conflux spools.
    """
    sides = np.stack((np.maximum(demands, 0.0), np.maximum(-demands, 0.0)), axis=2)
    return full_pressure * sides.reshape(len(demands), 12)


def measured_signals(log: Array, machine: Machine, rate_hz: float, rng: np.random.Generator | None) -> Array:
    """The 24 signals of Table A.1 in its order, SI units, shape (time, 24); no noise when `rng` is None."""
    velocity = log[:, plant_module.LOG_VELOCITY : plant_module.LOG_VELOCITY + 3]
    pressures = log[:, at.HEAD : at.HEAD + 6]
    if rng is not None:
        velocity = velocity + rng.normal(0.0, machine.sensors.velocity, velocity.shape)
        pressures = pressures + rng.normal(0.0, machine.sensors.pressure, pressures.shape)
    acceleration = filtered_derivative(velocity, machine.sensors.acceleration_bandwidth, rate_hz)
    demands = log[:, plant_module.LOG_DEMAND : plant_module.LOG_DEMAND + at.SPOOLS]
    pilots = pilot_demands(demands, machine.valves.pilot_pressure)
    return np.concatenate((velocity, acceleration, pressures, pilots), axis=1)


def truth_signals(log: Array) -> dict[str, Array]:
    """Noise-free further signals by the names of `EXTRA_CHANNELS`."""
    columns: dict[str, Array] = {}
    for m in range(2):
        columns[f"PumpPressure_{m + 1}"] = log[:, at.PUMP + m]
    for i in range(at.AXES):
        columns[f"CylStroke_{i + 1}"] = log[:, plant_module.LOG_STROKE + i]
        columns[f"JointAngle_{i + 1}"] = log[:, at.PSI + i]
        columns[f"JointVel_{i + 1}"] = log[:, at.RATE + i]
    return columns
