"""Logged signals from ground truth, by the sensor and bus model of a machine (its ``[sensors]``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.sensors import alterations, chain, draws

Array = NDArray[np.float64]
OIL = "OilTemperature"
KELVIN = 273.15
"""Offset from degC to K. Plant logs use degC, recordings use K."""


def measure_signals(
    log: Array,
    machine: Machine,
    rate_hz: float,
    rng: np.random.Generator | None,
    oil_temperature: Array | None = None,
) -> Array:
    """Return the 24 signals of Table A.1 in order, SI units, shape (time, 24); the ground truth if `rng` is None.

    No sample depends on a later one. Acceleration is the filtered derivative of the measured velocity.

    Args:
        log: rows of the plant.
        machine: machine with the ``[sensors]`` to use.
        rate_hz: rate of the log.
        rng: source of noise, bias, jitter and losses of this recording.
        oil_temperature: oil temperature for the drift of the pressures, K, shape (time,); default: the machine's
            constant.
    """
    if oil_temperature is None:
        oil_temperature = np.full(len(log), machine.oil.temperature + 273.15)
    drawn = draws.draw(machine, len(log), rate_hz, rng)
    return observe_signals(log, machine, rate_hz, rng is not None, drawn, oil_temperature)[:, : chain.MEASURED]


def observe_signals(
    log: Array,
    machine: Machine,
    rate_hz: float,
    noisy: bool,
    drawn: Array,
    oil_temperature: Array,
    faults: Array | None = None,
) -> Array:
    """Return all observed values, shape (time, `chain.SENSED`): Table A.1, then noise-free ones that may have faults.

    Args:
        log: rows of the plant.
        machine: machine with the ``[sensors]`` to use.
        rate_hz: rate of the log.
        noisy: False for the truth.
        drawn: random values of `draws.draw`, followed by one column per fault.
        oil_temperature: oil temperature, K, shape (time,).
        faults: sensor faults, one row each; see `edp.sim.sensors.alterations`.
    """
    setup = draws.pack_sensors(machine, rate_hz, noisy, faults)
    measured = np.empty((len(log), chain.SENSED))
    state = chain.new_state(draws.depth(drawn), alterations.memory_shape(setup[3], drawn[:, chain.DRAWS :]))
    chain.sense_all(np.ascontiguousarray(log), np.ascontiguousarray(oil_temperature), drawn, setup, state, measured)
    return measured


def truth_columns(width: int) -> dict[str, int]:
    """Return the columns of a log with this width by the names of `EXTRA_CHANNELS`.

    In soil the columns of `GROUND_CHANNELS` follow, then `MOTOR_CHANNELS` if swing and travel move.
    """
    columns: dict[str, int] = {}
    for m in range(2):
        columns[f"PumpPressure_{m + 1}"] = at.PUMP + m
        columns[f"PumpDisplacement_{m + 1}"] = at.DISPLACEMENT + m
    for i in range(at.AXES):
        columns[f"CylStroke_{i + 1}"] = at.LOG_STROKE + i
        columns[f"JointAngle_{i + 1}"] = at.PSI + i
        columns[f"JointVel_{i + 1}"] = at.RATE + i
    for j in range(at.SPOOLS):
        columns[f"SpoolPos_{j + 1}"] = at.LOG_SPOOL + j
    one_each = ("TipX", "TipY", "TipAngle", "TipForceX", "TipForceY", "Payload", OIL)
    events = ("Relief", "Cavitation", "Regeneration", "PowerLimit", "SoilContact")
    for n, name in enumerate((*one_each, *(f"Event_{event}" for event in events))):
        columns[name] = at.LOG_TIP + n
    points = at.GROUND_POINTS if width - at.LOG_GROUND >= at.GROUND_POINTS else 0
    for k in range(points):
        columns[f"Ground_{k:02d}"] = at.LOG_GROUND + k
    if width > at.LOG_GROUND + points:
        columns |= _motor_columns(at.LOG_GROUND + points)
    return columns


def _motor_columns(first: int) -> dict[str, int]:
    columns = {"SwingAngle": at.LOG_SWING, "SwingVel": at.LOG_MOTOR_SPEED}
    for i, part in enumerate(("Swing{}", "Track{}_1", "Track{}_2")):
        columns[part.format("Demand")] = at.LOG_MOTOR_DEMAND + i
        columns[part.format("Spool")] = at.LOG_MOTOR_SPOOL + i
    for port, column in enumerate((at.LOG_MOTOR_A, at.LOG_MOTOR_B), start=1):
        columns[f"SwingPressure_{port}"] = column
        for n in range(2):
            columns[f"TrackPressure_{2 * n + port}"] = column + 1 + n
    columns |= {f"TrackVel_{n}": at.LOG_MOTOR_SPEED + n for n in (1, 2)}
    return {name: first + column for name, column in columns.items()}


def truth_signals(log: Array) -> dict[str, Array]:
    """Return additional noise-free signals by the names of `truth_columns`."""
    signals = {name: log[:, column] for name, column in truth_columns(log.shape[1]).items()}
    signals[OIL] = signals[OIL] + KELVIN
    return signals


def shown_names() -> dict[str, int]:
    """Return the positions of noise-free observed values in `observe_signals`, by the names of `EXTRA_CHANNELS`."""
    strokes = {f"CylStroke_{i + 1}": chain.STROKES + i for i in range(at.AXES)}
    return {**strokes, "PumpPressure_1": chain.PUMPS, "PumpPressure_2": chain.PUMPS + 1, OIL: chain.OIL}
