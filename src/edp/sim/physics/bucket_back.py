"""Back of the bucket: soil resistance, soil pushed ahead, and soil displaced by the heel.

Passive earth pressure on an upright rough wall by the lower bound of Lancellotta (Geotechnique 52, 2002, 617-619),
which has Rankine's value without friction on the wall; cohesion by Caquot's corresponding states, so that every stress
is larger by c cot(phi). Soil is moved in the height profile, which counts mass.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.ground_profile import DEEPEST, GRAVITY, SPACING, height_at, rut_depth
from edp.sim.physics.jit import compiled
from edp.sim.physics.material import Material

Array = NDArray[np.float64]
# numbers of the back: share pushed ahead (0: the back moves no soil), N/m^2 and N/m of depth, tangent of its friction
SHARE, WEIGHT, HOLD, LIFT = range(4)
VALUES = 4
MIN_FRICTION = math.radians(0.1)
"""Friction angle (rad) below which the cohesive limit 2 c is accurate to 0.2 %."""
AHEAD_CELLS, BEHIND_CELLS, ASIDE_CELLS = 4, 2, 3
"""Number of ground cells over which soil spreads ahead of the bucket's back, behind it, and to either side of the heel.
"""
TRIMMED = 0.005
"""Travel (m) within which soil above the line of the floor plate is removed below the plate."""
FURTHER_M = 1.0
"""Distance (m) ahead of the bucket's back beyond which its heap does not reach. A heap of 0.4 m at its angle of repose
is shorter."""
HEEL_CELLS = 2
"""Number of cells on either side of the heel's cell that are pressed by its length of 0.2 m."""


def passive_coefficient(friction: float, wall: float) -> float:
    """Return the horizontal over vertical stress on an upright wall at passive failure.

    `wall`: its friction (rad), at most `friction`, that of the soil.
    """
    sine = math.sin(wall)
    root = math.sqrt(max(math.sin(friction) ** 2 - sine * sine, 0.0))
    turned = math.asin(min(sine / math.sin(friction), 1.0)) + wall
    plain = math.cos(wall) * (math.cos(wall) + root) / (1.0 - math.sin(friction))
    return plain * math.exp(turned * math.tan(friction))


def pack(material: Material, width: float) -> Array:
    """Return the parameters of the back for compiled code, all 0 if it moves no soil."""
    if material.back_push == 0.0:
        return np.zeros(VALUES)
    friction = max(math.radians(material.friction_deg), MIN_FRICTION)
    wall = min(math.radians(material.back_friction_deg), friction)
    k = passive_coefficient(friction, wall)
    weight = 0.5 * material.density * GRAVITY * k * width
    return np.array([material.back_push, weight, material.cohesion * (k - 1.0) / math.tan(friction) * width,
                     math.tan(wall)])  # fmt: skip


@compiled
def pressure(depth: float, grown: float, back: Array) -> float:
    """Return the horizontal force (N) of the soil on the back immersed by `depth` (m).

    `grown` is the depth (m) below the ground level `FURTHER_M` ahead. Soil heaped above this level adds weight but no
    cohesion.
    """
    force: float = back[WEIGHT] * depth * depth + back[HOLD] * min(max(grown, 0.0), depth)
    return force


@compiled
def measure_soil_ahead(points: Array, heights: Array, memory: Array, back: Array) -> tuple[float, float]:
    """Return depth (m) of the lower of tip and heel, `points`, in the soil ahead of both, and that soil's force (N)."""
    low, front = min(points[1], points[3]), max(points[0], points[2])
    # 1.5 cells ahead: the cell of the front itself is cleared already.
    ahead = front + 1.5 * SPACING
    depth = min(height_at(ahead, heights) - rut_depth(ahead, heights, memory) - low, DEEPEST)
    if depth <= 0.0:
        return 0.0, 0.0
    return depth, pressure(depth, height_at(front + FURTHER_M, heights) - low, back)


@compiled
def push(points: Array, moved: float, share: float, heights: Array, memory: Array) -> None:
    """Move the soil above the floor plate's line that an outward motion has reached to both sides.

    Args:
        points: x and y of tip and heel (m).
        moved: outward travel in this step (m).
        share: fraction of the soil that moves ahead of the bucket; the rest flows around the bucket and stays behind
            it.
        heights: height profile of the ground.
        memory: memory of the ground, including its ruts.
    """
    rear, front, low, high = points[0], points[2], points[1], points[3]
    if front < rear:
        rear, front, low, high = front, rear, high, low
    end = heights.shape[0] - 1
    first = min(max(int((rear - moved) / SPACING + 0.5), 0), end)
    last = min(max(int(front / SPACING + 0.5), 0), end)
    slope = (high - low) / max(front - rear, 1e-9)
    before, cut = height_at(points[2], heights), 0.0
    for k in range(first, last + 1):
        x = min(max(k * SPACING, rear), front)
        y = low + slope * (x - rear)
        if heights[k] - memory[at.MEMORY + k] <= y:
            continue
        if k == last:
            # Of the front's own cell only the part passed in this step; 1e-12 avoids 0 / 0 at a cell's border.
            left = max((k + 0.5) * SPACING - front, 0.0)
            part = moved / (moved + left + 1e-12)
        else:
            part = 1.0 if (k + 0.5) * SPACING <= rear else min(moved / TRIMMED, 1.0)
        slice_ = part * (heights[k] - y)
        memory[at.MEMORY + k] *= 1.0 - part
        heights[k] -= slice_
        cut += slice_
    # What bears the heel has become lower by as much.
    memory[at.HEEL_SET] = max(memory[at.HEEL_SET] - max(before - height_at(points[2], heights), 0.0), 0.0)
    # Clamped at both ends of the profile, so that no mass is lost there.
    for n in range(AHEAD_CELLS):
        heights[min(last + 1 + n, end)] += cut * share / AHEAD_CELLS
    for n in range(BEHIND_CELLS):
        heights[max(first - 1 - n, 0)] += cut * (1.0 - share) / BEHIND_CELLS


@compiled
def shove_aside(x: float, depth: float, heights: Array, memory: Array) -> None:
    """Leave the print of a heel pressed in by `depth` (m) at `x`: soil that was not compacted rises on both sides."""
    end = heights.shape[0] - 1
    middle = min(max(int(x / SPACING + 0.5), 0), end)
    bottom = height_at(x, heights) - depth
    flowed = depth - rut_depth(x, heights, memory)
    if flowed <= 0.0:
        return
    first, last, cut = max(middle - HEEL_CELLS, 0), min(middle + HEEL_CELLS, end), 0.0
    for k in range(first, last + 1):
        slice_ = min(flowed, max(heights[k] - bottom, 0.0))
        heights[k] -= slice_
        cut += slice_
    for n in range(ASIDE_CELLS):
        heights[max(first - 1 - n, 0)] += 0.5 * cut / ASIDE_CELLS
        heights[min(last + 1 + n, end)] += 0.5 * cut / ASIDE_CELLS
