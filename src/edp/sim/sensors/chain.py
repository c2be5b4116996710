"""Sensor and bus model for one logged sample; the only implementation of the chain.

Recordings and episodes run the same compiled function: recordings for all rows of a log, episodes row by row. All
    random values of a recording are generated before it begins (`edp.sim.sensors.draws`), one row per sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import linkage, pins
from edp.sim.physics.jit import compiled, inlined
from edp.sim.sensors import alterations, filters, transducers

Array = NDArray[np.float64]
REFERENCE_TEMPERATURE = 313.15
"""Oil temperature at which pressure transmitters are calibrated, K (40 degC)."""
MEASURED = 24
"""Names of the signals of Table A.1."""
STROKES, PUMPS, OIL = 24, 27, 29
SENSED = 30
"""Names of all observable signals: Table A.1, then strokes, pump pressures and oil temperature, which have no noise."""
VELOCITIES, PRESSURES, PILOTS = 0, 6, 12

# drawn[tick, ...]: when the values that each ECU shows were read, in ticks; bias and errors of joint rates (rad/s),
# errors of cylinder velocities (m/s) and pressures (Pa)
AT_JOINTS, AT_PRESSURES, AT_VALVES, RATE_BIAS, RATE_ERROR, VELOCITY_ERROR, PRESSURE_ERROR = 0, 1, 2, 3, 6, 9, 12
DRAWS = 18
"""Number of random values per sample. One column per sensor fault follows with the fault value of the sample, see
`edp.sim.sensors.alterations`."""
# numbers[...]: sizes of one machine's sensors at one rate
(
    NOISY, STEP_S, PILOT_FULL, DERIVATIVE, LAGGED, LAG, RANGE, QUANTUM, DRIFT, ANGLE_QUANTUM, LEVERED, PLAYING, PLAY,
    OFFSET, PRESSURES_FROM,
) = 0, 1, 2, 3, 8, 9, 12, 13, 14, 15, 16, 17, 18, 21, 27  # fmt: skip
SENSOR_NUMBERS = 28
# memory[...]: play of the pins (offset, speed, force), first pressures and state of their lag, first velocities and
# states of their derivative
PIN, PIN_SPEED, PIN_FORCE, FIRST_PRESSURE, LAG_STATE, FIRST_VELOCITY, DERIVATIVE_STATE = 0, 3, 6, 9, 15, 21, 24
SENSOR_MEMORY = 30
# history[tick, ...]: what frames of the bus read between ticks
VELOCITY, ANGLE, RATE, PRESSURE, TEMPERATURE, DEMAND = 0, 3, 6, 9, 15, 16
REMEMBERED = 22
Setup = tuple[Array, Array, Array, Array]
"""Configuration of the sensors: sensor parameters, `axes` and `plant` of the machine as built, and table of faults."""
State = tuple[Array, Array, Array, Array]


@inlined
def remember(sample: Array, kelvin: float, tick: int, setup: Setup, memory: Array, row: Array, work: Array) -> None:
    """Write the quantities sensed at this sample to `row` of the history; `sample` is one log row, (1, columns)."""
    numbers, axes, plant, _ = setup
    if numbers[PLAYING] > 0.0:
        force, mass = work[0:1], work[1:2]
        pins.fill_loads(sample, axes, plant, force, mass)
    for i in range(at.AXES):
        v = sample[0, at.LOG_VELOCITY + i]
        if numbers[PLAYING] > 0.0:
            half, now = 0.5 * numbers[PLAY + i], work[0, i]
            if tick == 0:
                memory[PIN + i], memory[PIN_SPEED + i] = pins.first_offset(now, half), 0.0
            else:
                before = (memory[PIN + i], memory[PIN_SPEED + i])
                pull = (memory[PIN_FORCE + i], now)
                after = pins.cross_play(pull, work[1, i], half, numbers[STEP_S], before)
                memory[PIN + i], memory[PIN_SPEED + i] = after
                v += (after[0] - before[0]) / numbers[STEP_S]
            memory[PIN_FORCE + i] = now
        row[VELOCITY + i], row[ANGLE + i], row[RATE + i] = v, sample[0, at.PSI + i], sample[0, at.RATE + i]
    for n in range(6):
        p = sample[0, int(numbers[PRESSURES_FROM]) + n]
        if numbers[LAGGED] > 0.0:
            if tick == 0:
                memory[FIRST_PRESSURE + n], memory[LAG_STATE + n] = p, 0.0
            x = p - memory[FIRST_PRESSURE + n]
            y = numbers[LAG] * x + memory[LAG_STATE + n]
            memory[LAG_STATE + n] = numbers[LAG + 1] * x + numbers[LAG + 2] * y
            p = memory[FIRST_PRESSURE + n] + y
        row[PRESSURE + n] = p
    row[TEMPERATURE] = kelvin
    for j in range(at.SPOOLS):
        row[DEMAND + j] = sample[0, at.LOG_DEMAND + j]


@inlined
def between(history: Array, position: float) -> tuple[Array, Array, float]:
    """Return the stored rows around a position in samples, and the interpolation weight of the second."""
    low = int(position)
    part = position - low
    # At the time of a sample the next sample may not be available.
    high = low + 1 if part > 0.0 else low
    return history[low % history.shape[0]], history[high % history.shape[0]], part


@inlined
def read_joints(drawn: Array, setup: Setup, history: Array, out: Array) -> None:
    """Compute the cylinder velocities sent by the joints' ECU: v = J(measured angle) * measured rate."""
    numbers, _, plant, _ = setup
    low, high, part = between(history, drawn[AT_JOINTS])
    for i in range(at.AXES):
        v = low[VELOCITY + i] + part * (high[VELOCITY + i] - low[VELOCITY + i])
        if numbers[LEVERED] > 0.0:
            angle = low[ANGLE + i] + part * (high[ANGLE + i] - low[ANGLE + i])
            rate = low[RATE + i] + part * (high[RATE + i] - low[RATE + i])
            shown = transducers.quantised(angle, numbers[ANGLE_QUANTUM])
            lever = linkage.cylinder(i, shown, plant)[1]
            error = drawn[RATE_BIAS + i] + drawn[RATE_ERROR + i]
            # The velocity already includes the play; add the effect of angle quantisation and rate error on J times
            # rate.
            v = v + (lever - linkage.cylinder(i, angle, plant)[1]) * rate + lever * error
        out[i] = v + drawn[VELOCITY_ERROR + i]


@inlined
def read_pressures(drawn: Array, numbers: Array, history: Array, out: Array) -> None:
    """Compute the cylinder pressures sent by the transmitters' ECU, in ``out[6:12]``."""
    low, high, part = between(history, drawn[AT_PRESSURES])
    warmer = low[TEMPERATURE] + part * (high[TEMPERATURE] - low[TEMPERATURE]) - REFERENCE_TEMPERATURE
    drift = numbers[DRIFT] * warmer
    for n in range(6):
        p = low[PRESSURE + n] + part * (high[PRESSURE + n] - low[PRESSURE + n])
        p = p + numbers[RANGE] * (numbers[OFFSET + n] + drift)
        p = p + drawn[PRESSURE_ERROR + n]
        # In the order of a transmitter: first the range limit, then the converter.
        out[6 + n] = transducers.quantised(transducers.limited(p, numbers[RANGE]), numbers[QUANTUM])


@inlined
def read_pilots(position: float, full: float, history: Array, out: Array) -> None:
    """Write the 12 one-sided pilot pressures sent by the valve ECU to ``out[12:24]``."""
    low, high, part = between(history, position)
    for j in range(at.SPOOLS):
        a, b = low[DEMAND + j], high[DEMAND + j]
        up_a, up_b, down_a, down_b = full * max(a, 0.0), full * max(b, 0.0), full * max(-a, 0.0), full * max(-b, 0.0)
        out[12 + 2 * j] = up_a + part * (up_b - up_a)
        out[13 + 2 * j] = down_a + part * (down_b - down_a)


@inlined
def differentiate(tick: int, numbers: Array, memory: Array, out: Array) -> None:
    """Compute accelerations, the filtered derivative of the shown velocities, in ``out[3:6]``."""
    coefficients = numbers[DERIVATIVE : DERIVATIVE + 5]
    for i in range(at.AXES):
        first = DERIVATIVE_STATE + 2 * i
        if tick == 0:
            memory[FIRST_VELOCITY + i] = out[i]
            memory[first] = memory[first + 1] = 0.0
        out[3 + i] = filters.biquad(out[i] - memory[FIRST_VELOCITY + i], coefficients, memory[first : first + 2])


@compiled
def sense(
    sample: Array,
    kelvin: float,
    tick: int,
    drawn: Array,
    setup: Setup,
    state: State,
    out: Array,
) -> None:
    """Write the 24 signals of Table A.1 and the additional observed values at one sample to `out`, shape (SENSED,).

    Samples must be processed in order from 0, which starts the chain in steady state.

    Args:
        sample: row of the log, shape (1, columns).
        kelvin: oil temperature, K.
        tick: index of the sample, from 0.
        drawn: random values of the sample, a row of `draws.draw`.
        setup: result of `draws.pack_sensors`.
        state: memory, history (a ring of ticks), scratch of shape (2, 3) and memory of the faults.
        out: filled.
    """
    numbers = setup[0]
    memory, history, work, fault_memory = state
    row = history[tick % history.shape[0]]
    if numbers[NOISY] > 0.0:
        remember(sample, kelvin, tick, setup, memory, row, work)
        read_joints(drawn, setup, history, out)
        read_pressures(drawn, numbers, history, out)
        read_pilots(drawn[AT_VALVES], numbers[PILOT_FULL], history, out)
    else:
        for j in range(at.SPOOLS):
            row[DEMAND + j] = sample[0, at.LOG_DEMAND + j]
        for i in range(at.AXES):
            out[i] = sample[0, at.LOG_VELOCITY + i]
        for n in range(6):
            out[6 + n] = sample[0, int(numbers[PRESSURES_FROM]) + n]
        read_pilots(float(tick), numbers[PILOT_FULL], history, out)
    for i in range(at.AXES):
        out[STROKES + i] = sample[0, at.LOG_STROKE + i]
    out[PUMPS], out[PUMPS + 1], out[OIL] = sample[0, at.PUMP], sample[0, at.PUMP + 1], kelvin
    # Before the derivative, which the machine's computer takes of the velocities that it is shown.
    full_scale, quantum = (numbers[RANGE], numbers[QUANTUM]) if numbers[NOISY] > 0.0 else (0.0, 0.0)
    transmitter = (PRESSURES, PILOTS, full_scale, quantum)
    alterations.alter(tick, drawn[DRAWS:], setup[3], fault_memory, transmitter, out)
    differentiate(tick, numbers, memory, out)


@compiled
def sense_all(
    log: Array,
    kelvin: Array,
    drawn: Array,
    setup: Setup,
    state: State,
    out: Array,
) -> None:
    """Apply `sense` to every row of a log from steady state.

    Shapes (time, columns), (time,), (time, draws), (time, SENSED).
    """
    for k in range(log.shape[0]):
        sense(log[k : k + 1], kelvin[k], k, drawn[k], setup, state, out[k])


def new_state(depth: int, fault_memory: tuple[int, int] = (0, 2)) -> State:
    """Return the memory, history of `depth` ticks, scratch, and memory of faults of this shape."""
    return np.zeros(SENSOR_MEMORY), np.zeros((depth, REMEMBERED)), np.zeros((2, at.AXES)), np.zeros(fault_memory)
