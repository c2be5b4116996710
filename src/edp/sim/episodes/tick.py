"""One sample of many episodes: from lever positions over plant and sensors to observations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.episodes import blocks
from edp.sim.machine import layout as at
from edp.sim.physics import commands, plant, terramechanics
from edp.sim.physics import scratch as places
from edp.sim.physics.jit import compiled, inlined, pasted
from edp.sim.physics.scratch import MovingParts, SpoolCommands
from edp.sim.sensors import chain, logbook

Array = NDArray[np.float64]
LOG_WIDTH = at.LOG_GROUND + at.GROUND_POINTS
SOURCES = chain.SENSED + LOG_WIDTH
"""Possible observations: the sensed signals, then every column of the log."""
Out = tuple[NDArray[np.float32], Array, NDArray[np.bool_]]
"""Results of a time step: observations ``(episode, column)``, current rows of the log ``(episode, LOG_WIDTH)``, and
mask of ended episodes."""
KELVIN = 273.15

# what `step_all` reports
FINE, NOT_FINITE_LEVER, DIVERGED = 0, 1, 2
Setup = tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]]


@inlined
def finite(value: float) -> bool:
    """Return whether a number is finite; where sums may be reordered, a compiler takes the test of Python as passed."""
    return math.isfinite(value)


@pasted
def scratch_of(scratch: Array) -> tuple[Array, ...]:
    """Return the work arrays of `integrator.new_work`, as parts of one array of at least `SCRATCH` values."""
    ends = (
        places.FROZEN,
        places.FROZEN + 3,
        places.FROZEN + 3 + 3 * at.OPENINGS,
        places.FROZEN + 28 + 3 * at.OPENINGS,
        places.FROZEN + 28 + 3 * at.OPENINGS + 4 * places.SLOPES,
        places.FROZEN + 28 + 3 * at.OPENINGS + 4 * places.SLOPES + terramechanics.CONTACTS,
    )
    return (
        scratch[: ends[0]],
        scratch[ends[0] : ends[1]],
        scratch[ends[1] : ends[2]].reshape(3, at.OPENINGS),
        scratch[ends[2] : ends[3]].reshape(5, 5),
        scratch[ends[3] : ends[4]].reshape(4, places.SLOPES),
        scratch[ends[4] : ends[5]],
        scratch[ends[5] : ends[5] + at.STATES],
        scratch[ends[5] + at.STATES : ends[5] + 2 * at.STATES],
        scratch[ends[5] + 2 * at.STATES : ends[5] + 3 * at.STATES],
        scratch[ends[5] + 3 * at.STATES : ends[5] + 4 * at.STATES],
        scratch[ends[5] + 4 * at.STATES : ends[5] + 5 * at.STATES],
    )


SCRATCH = places.FROZEN + 28 + 3 * at.OPENINGS + 4 * places.SLOPES + terramechanics.CONTACTS + 5 * at.STATES
MAX_PAST = 256
"""Maximum dead time of a machine in samples."""


@pasted
def setup_of(memory: Array, drawn: Array, scratch: Array) -> Setup:
    """Return the arguments of the plant's step: axes, plant, work and ground arrays."""
    ground = (
        blocks.line(blocks.SOIL_NUMBERS, memory, memory),
        blocks.table(blocks.SOIL_TABLES, memory, drawn),
        blocks.table(blocks.SOIL_COURSE, memory, drawn),
        blocks.line(blocks.HEIGHTS, memory, memory),
        blocks.line(blocks.GROUND_MEMORY, memory, memory),
    )
    axes, numbers = blocks.table(blocks.AXES, memory, memory), blocks.line(blocks.PLANT, memory, memory)
    return axes, numbers, scratch_of(scratch), ground


@inlined
def move(memory: Array, lever: Array, setup: Setup, room: Array) -> int:
    """Run the plant for one sample from its logged row; returns the number of clamped pressures.

    `lever` has shape (1, 3); `room` is scratch, which ends with the past demands and the new one.
    """
    state, valves = blocks.line(blocks.STATE, memory, memory), blocks.table(blocks.VALVES, memory, memory)
    past, hand = blocks.table(blocks.PAST, memory, memory), blocks.table(blocks.HAND, memory, memory)
    coarse, fine = blocks.line(blocks.COARSE, memory, memory), blocks.line(blocks.FINE, memory, memory)
    numbers = blocks.line(blocks.NUMBER, memory, memory)
    coarse_filters = blocks.line(blocks.COARSE_FILTERS, memory, memory).reshape(at.SPOOLS, 2, 4)
    fine_filters = blocks.line(blocks.FINE_FILTERS, memory, memory).reshape(at.SPOOLS, 2, 4)
    clocks = (
        (int(coarse[0]), coarse[1], coarse[2], coarse_filters),
        (int(fine[0]), fine[1], fine[2], fine_filters),
    )
    times = (blocks.line(blocks.DELAYS, memory, memory), clocks)
    count = past.shape[0]
    one_demand = room[: at.SPOOLS]
    demands = room[at.SPOOLS : at.SPOOLS * (count + 2)].reshape(count + 1, at.SPOOLS)
    commands.shape_commands(lever, hand, numbers[blocks.HAND_S], past, setup, demands, one_demand)
    row = blocks.line(blocks.ROW, memory, memory)
    return plant.run_sample(MovingParts(state, valves), SpoolCommands(demands, one_demand), count, times, setup, row)


@inlined
def change(memory: Array, drawn: Array) -> None:
    """Update the plant parameters to the faults of this sample."""
    numbers, changes = blocks.line(blocks.NUMBER, memory, memory), blocks.table(blocks.CHANGES, memory, drawn)
    done = int(numbers[blocks.CHANGED])
    while done < changes.shape[0] and changes[done, blocks.AT_TICK] <= numbers[blocks.TICK]:
        first = int(memory[blocks.ENTRY * int(changes[done, blocks.BLOCK])])
        memory[first + int(changes[done, blocks.WITHIN])] = changes[done, blocks.VALUE]
        done += 1
    numbers[blocks.CHANGED] = done


@inlined
def look(memory: Array, drawn: Array, setup: Setup, work: Array) -> None:
    """Log the current sample and compute its sensor readings."""
    state, valves = blocks.line(blocks.STATE, memory, memory), blocks.table(blocks.VALVES, memory, memory)
    past, row = blocks.table(blocks.PAST, memory, memory), blocks.table(blocks.ROW, memory, memory)
    tick = int(blocks.line(blocks.NUMBER, memory, memory)[blocks.TICK])
    # The newest demand is that of the sample that ends here: the next one is not yet decided.
    logbook.write_log(MovingParts(state, valves), past[past.shape[0] - 1], setup, row[0])
    sensor_setup = (
        blocks.line(blocks.SENSOR_NUMBERS, memory, memory),
        blocks.table(blocks.SENSOR_AXES, memory, memory),
        blocks.line(blocks.SENSOR_PLANT, memory, memory),
        blocks.table(blocks.SENSOR_FAULTS, memory, memory),
    )
    sensor_state = (
        blocks.line(blocks.SENSOR_MEMORY, memory, memory),
        blocks.table(blocks.HISTORY, memory, memory),
        work,
        blocks.table(blocks.FAULT_MEMORY, memory, memory),
    )
    draws = blocks.table(blocks.SENSOR_DRAWS, memory, drawn)
    measured = blocks.line(blocks.MEASURED, memory, memory)
    chain.sense(row, row[0, at.LOG_OIL] + KELVIN, tick, draws[tick], sensor_setup, sensor_state, measured)


@inlined
def show(memory: Array, drawn: Array, columns: NDArray[np.int64], index: int, out: Out) -> None:
    """Write the observation of this sample: the measurement delayed by `DELAY` samples, or the previous one if lost."""
    observation, log_row = out[0][index], out[1][index]
    numbers, shown = blocks.line(blocks.NUMBER, memory, memory), blocks.table(blocks.SHOWN, memory, memory)
    measured, row = blocks.line(blocks.MEASURED, memory, memory), blocks.line(blocks.ROW, memory, memory)
    tick, ring = int(numbers[blocks.TICK]), shown.shape[0] - 1
    late = int(numbers[blocks.DELAY])
    # The last row of the block is the previous observation.
    last, now = shown[ring], shown[tick % ring]
    for c in range(columns.shape[0]):
        source = columns[c]
        now[c] = measured[source] if source < chain.SENSED else row[source - chain.SENSED]
    visible = shown[max(tick - late, 0) % ring]
    if tick == 0 or blocks.line(blocks.LOST, memory, drawn)[tick] == 0.0:
        for c in range(columns.shape[0]):
            last[c] = visible[c]
    for c in range(columns.shape[0]):
        observation[c] = last[c]
    for n in range(LOG_WIDTH):
        # In free air there is no ground to show.
        log_row[n] = row[n] if n < row.shape[0] else math.nan
    out[2][index] = numbers[blocks.TICK] >= numbers[blocks.SAMPLES] - 1.0


@compiled
def step_all(
    memory: Array,
    drawn: Array,
    levers: Array,
    active: NDArray[np.bool_],
    columns: NDArray[np.int64],
    scratch: Array,
    out: Out,
) -> tuple[int, int]:
    """Advance every active episode by one sample; return the first failure and its kind.

    Args:
        memory: rows that change, shape (episode, ...).
        drawn: rows of random values, shape (episode, ...).
        levers: lever positions, shape (episode, 3), clipped to [-1, 1].
        active: episodes to step, shape (episode,).
        columns: observed columns, see `SOURCES`.
        scratch: at least `SCRATCH` and ``6 (MAX_PAST + 2) + 9`` values.
        out: results, written for the active episodes.
    """
    for e in range(memory.shape[0]):
        # Check before any episode advances, so that an invalid lever changes no episode.
        if active[e] and not finite(levers[e, 0] + levers[e, 1] + levers[e, 2]):
            return e, NOT_FINITE_LEVER
    lever, work = scratch[:3].reshape(1, 3), scratch[3:9].reshape(2, 3)
    room = scratch[9 : 9 + at.SPOOLS * (MAX_PAST + 2)]
    rest = scratch[9 + at.SPOOLS * (MAX_PAST + 2) :]
    failed, how = -1, FINE
    for e in range(memory.shape[0]):
        if not active[e]:
            continue
        setup = setup_of(memory[e], drawn[e], rest)
        for i in range(at.AXES):
            lever[0, i] = min(max(levers[e, i], -1.0), 1.0)
        numbers = blocks.line(blocks.NUMBER, memory[e], memory[e])
        numbers[blocks.CLAMPS] += move(memory[e], lever, setup, room)
        numbers[blocks.TICK] += 1.0
        change(memory[e], drawn[e])
        look(memory[e], drawn[e], setup, work)
        show(memory[e], drawn[e], columns, e, out)
        total = 0.0
        for n in range(at.STATES):
            total += blocks.line(blocks.STATE, memory[e], memory[e])[n]
        # A non-finite value persists, so one sum detects it.
        if not finite(total) and failed < 0:
            failed, how = e, DIVERGED
    return failed, how


@compiled
def begin(memory: Array, drawn: Array, columns: NDArray[np.int64], scratch: Array, index: int, out: Out) -> None:
    """Write the observation of episode `index` before its first sample, from its rows of `memory` and `drawn`."""
    rest, work = scratch[9 + at.SPOOLS * (MAX_PAST + 2) :], scratch[3:9].reshape(2, 3)
    setup = setup_of(memory, drawn, rest)
    change(memory, drawn)
    look(memory, drawn, setup, work)
    show(memory, drawn, columns, index, out)


def new_scratch() -> Array:
    """Return the scratch array for `step_all` and `begin`."""
    return np.zeros(9 + at.SPOOLS * (MAX_PAST + 2) + SCRATCH)
