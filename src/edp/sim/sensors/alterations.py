"""Effect of faults on sensor readings at one sample; part of the chain, see `edp.sim.sensors.chain`.

A fault is a row of a table (operation, affected value, second value), one number per sample (0: no effect) and a row of
memory. Faults act in the order of their rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.physics.jit import inlined
from edp.sim.sensors import transducers

Array = NDArray[np.float64]
# table[fault, ...]
OPERATION, CHANNEL, OTHER = range(3)
COLUMNS = 3
# operations, and what the number of a tick is: an offset; a share added; 1 where the last value before stays; 1 where
# 0 is shown; what is left of a step after one tick of a lag; ticks of delay; 1 where two values change places; a factor
# less one on the noise, which acts on what was drawn and not here
OFFSET, SCALE, STUCK, DROPOUT, LAG, DELAY, SWAP, NOISE = range(8)


@inlined
def alter(
    tick: int,
    sizes: Array,
    table: Array,
    memory: Array,
    pressures: tuple[int, int, float, float],
    out: Array,
) -> None:
    """Put faults into the values of one tick, in place.

    Args:
        tick: index of the sample from 0; samples are processed in order.
        sizes: the number of each fault at this tick, shape (fault,).
        table: shape (fault, COLUMNS).
        memory: shape (fault, values), which must be at least as wide as a delay in ticks and 2.
        pressures: index of the first pressure, index after the last pressure, range and quantisation step of the
            transmitters.
        out: sensor values; updated in place.
    """
    first, behind, full_scale, quantum = pressures
    for f in range(table.shape[0]):
        what, a, size = int(table[f, OPERATION]), int(table[f, CHANNEL]), sizes[f]
        x = out[a]
        y = x
        if what == STUCK:
            if size == 0.0 or tick == 0:
                memory[f, 0] = x
            y = memory[f, 0]
        elif what == LAG:
            # Without a fault the memory follows the value, so that a lag begins at the previous reading.
            memory[f, 0] = x + size * (memory[f, 0] - x) if size > 0.0 and tick > 0 else x
            y = memory[f, 0]
        elif what == DELAY:
            ring = memory.shape[1]
            memory[f, tick % ring] = x
            if size > 0.0:
                when = max(tick - size, 0.0)
                low = int(when)
                part = when - low
                y = memory[f, low % ring]
                if part > 0.0:
                    y = y + part * (memory[f, (low + 1) % ring] - y)
        elif size != 0.0:
            if what == OFFSET:
                y = x + size
            elif what == SCALE:
                y = x + size * x
            elif what == DROPOUT:
                y = 0.0
            elif what == SWAP:
                b = int(table[f, OTHER])
                y = out[b]
                out[b] = x
        # The fault is in the sensing element, before the range and the converter of the transmitter.
        if first <= a < behind and size != 0.0 and what in (OFFSET, SCALE, LAG):
            y = transducers.quantised(transducers.limited(y, full_scale), quantum)
        out[a] = y


def memory_shape(table: Array, sizes: Array) -> tuple[int, int]:
    """Return the memory shape that `alter` needs for a table and the parameters of all samples, shape (time, fault)."""
    delays = sizes[:, table[:, OPERATION] == DELAY]
    # The tick itself, the one that a delay between ticks reads beside it, and room for rounding up.
    return len(table), (int(np.ceil(delays.max())) if delays.size else 0) + 2
