"""The height profile of the ground, and the ruts that lie below it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import compiled, inlined

Array = NDArray[np.float64]
SPACING = 0.05
"""Cell size of the ground profile, m."""
GRAVITY = 9.81
DEEPEST = 1.2
"""Depth (m) beyond which soil forces stay constant: about the height of a bucket."""
DEEPEST_RUT = 0.1
"""Maximum depth (m) to which soil can be compacted: a third of the layer affected by a plate of 0.2 m; E."""


@inlined
def height_at(x: float, heights: Array) -> float:
    """Return the height (m) of the ground at `x`, linear between its points."""
    # Just below the last point, so that k + 1 exists.
    cell = min(max(x / SPACING, 0.0), heights.shape[0] - 1.000001)
    k = int(cell)
    height: float = heights[k] + (cell - k) * (heights[k + 1] - heights[k])
    return height


@inlined
def rut_depth(x: float, heights: Array, memory: Array) -> float:
    """Return the rut depth (m) at `x`: compaction by the heel below the profile, whose heights count mass."""
    return height_at(x, memory[at.MEMORY : at.MEMORY + heights.shape[0]])


@compiled
def press(x: float, bottom: float, share: float, heights: Array, memory: Array) -> None:
    """Keep the rut that a heel at `x` makes down to `bottom` (m): its cells are never less deep than before.

    The fraction `share` of the rut is permanent. Below `DEEPEST_RUT` soil flows aside and back without a rut.
    """
    middle = int(x / SPACING + 0.5)
    for k in range(max(middle - 2, 0), min(middle + 3, heights.shape[0])):
        lasting = share * min(heights[k] - bottom, DEEPEST_RUT)
        memory[at.MEMORY + k] = max(memory[at.MEMORY + k], lasting)
