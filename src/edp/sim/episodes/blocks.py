"""Memory layout of an episode: a row of changing values, and a row of random values sampled before the start.

A copy of the two rows is the episode at that moment, exactly. Blocks of the rows have sizes of their own in each
episode (a machine's reach, its dead times, the latency of its bus), so that each row begins with a table of them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import pasted

Array = NDArray[np.float64]

# numbers[...], the first block of a changing row
TICK, SAMPLES, CLAMPS, HAND_S, IN_AIR, DELAY, CHANGED = range(7)
"""Indices of counters and constants of an episode: completed samples, total samples, number of clamped pressures, time
step of the operator's hand (0: none), 1 in free air, loop latency in samples, and number of applied fault changes."""
NUMBERS = 7

# blocks of the row that changes
(
    NUMBER, STATE, VALVES, HAND, PAST, AXES, PLANT, DELAYS, COARSE, FINE, COARSE_FILTERS, FINE_FILTERS,
    HEIGHTS, GROUND_MEMORY, SENSOR_NUMBERS, SENSOR_AXES, SENSOR_PLANT, SENSOR_MEMORY, HISTORY, ROW, MEASURED, SHOWN,
    SOIL_NUMBERS, SENSOR_FAULTS, FAULT_MEMORY,
) = range(25)  # fmt: skip
# blocks of the row that was drawn
SENSOR_DRAWS, LOST, SOIL_TABLES, SOIL_COURSE, CHANGES = range(25, 30)
BLOCKS = 30
CHANGING = 25
# changes[number, ...]: change of a parameter by a fault: sample, block, position in the block, and new value from this
# sample on
AT_TICK, BLOCK, WITHIN, VALUE = range(4)
ENTRY = 3
"""Number of values per entry of the block table: offset in the row, rows and columns of the block."""


@pasted
def table(index: int, memory: Array, row: Array) -> Array:
    """Return a two-dimensional block of `row`; the table of blocks is in `memory`, the changing row."""
    first, count, width = int(memory[ENTRY * index]), int(memory[ENTRY * index + 1]), int(memory[ENTRY * index + 2])
    return row[first : first + count * width].reshape(count, width)


@pasted
def line(index: int, memory: Array, row: Array) -> Array:
    """Return a one-dimensional block of `row`."""
    first, count = int(memory[ENTRY * index]), int(memory[ENTRY * index + 1]) * int(memory[ENTRY * index + 2])
    return row[first : first + count]


def rows_of(parts: Mapping[int, Array]) -> tuple[Array, Array]:
    """Return the two rows that hold these blocks, given one array per index."""
    head, changing, drawn = np.zeros((BLOCKS, ENTRY)), [np.zeros(0)], [np.zeros(0)]
    ends = [BLOCKS * ENTRY, 0]
    for index in range(BLOCKS):
        part = np.asarray(parts[index], dtype=float)
        side = 0 if index < CHANGING else 1
        head[index] = ends[side], (1 if part.ndim < 2 else len(part)), part.shape[-1]
        ends[side] += part.size
        (changing, drawn)[side].append(part.ravel())
    return np.concatenate([head.ravel(), *changing]), np.concatenate(drawn)


def view(index: int, memory: Array, drawn: Array) -> Array:
    """Return a block as a view, shape (rows, columns)."""
    first, count, width = (int(v) for v in memory[ENTRY * index : ENTRY * index + ENTRY])
    row = memory if index < CHANGING else drawn
    return row[first : first + count * width].reshape(count, width)
