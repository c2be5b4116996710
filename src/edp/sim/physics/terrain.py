"""Soil transport: excavated cells, bucket load and spilling, heap ahead of the edge, sliding slopes.

Heights refer to soil at bank density, and the mass of soil is conserved. Compacted soil is lower by its rut. A cut
removes the compacted soil with its mass and leaves soil that was not loaded before.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import bucket_back
from edp.sim.physics import terramechanics as tm
from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]
SPILL_S = 0.25
"""Time constant of soil that slides out of the bucket, s; E."""
HOLDS_RAD, EMPTY_RAD = 0.61, 1.75
"""Tilt of the bucket opening from the horizontal (rad) up to which the bucket holds a struck load, and at which the
bucket is empty; E."""
DROP_CELLS = 8
"""Distance ahead of the edge, in cells, at which soil falls that the heap cannot hold."""
NEAR_M = 0.1
"""Gap (m) below which the bucket may touch the ground within one sample. The bucket moves less than 5 cm per sample."""
LANDING = 0.05
"""Impact speed (m/s) above which a landing is simulated in fine steps."""
LEFT_M = 0.03
"""Height above the ground at which a dig has ended, m."""


@compiled
def cell_of(x: float, heights: Array) -> int:
    """Return the cell that contains `x`."""
    result: int = min(max(int(x / tm.SPACING + 0.5), 0), heights.shape[0] - 1)
    return result


@compiled
def drop(mass: float, x: float, cells: int, numbers: Array, heights: Array) -> None:
    """Spread a mass (kg) over some cells from `x` towards the machine."""
    first = cell_of(x, heights)
    share = mass / (cells * numbers[tm.DENSITY] * numbers[tm.WIDTH] * tm.SPACING)
    for n in range(cells):
        # Clamped at the first cell, so that no mass is lost at the tracks.
        heights[max(first - n, 0)] += share


@compiled
def sweep(c: Array, moved: float, numbers: Array, heights: Array, memory: Array) -> None:
    """Cut the edge's cell down to its path; the soil goes into the bucket until it is full, then onto the heap."""
    x, y = c[tm.POINTS], c[tm.POINTS + 1]
    k = cell_of(x, heights)
    left = max(x - (k - 0.5) * tm.SPACING, 0.0)
    before = cell_of(x + moved, heights)
    cut = 0.0
    for n in range(k + 1, before + 1):
        if heights[n] - memory[at.MEMORY + n] > y:
            cut += heights[n] - y
            heights[n] = y
            memory[at.MEMORY + n] = 0.0
    if heights[k] - memory[at.MEMORY + k] > y:
        inside = min(moved, tm.SPACING)
        # Of the edge's own cell only the part passed in this step; 1e-12 avoids 0 / 0 at a cell's border.
        slice_ = (heights[k] - y) * inside / (inside + left + 1e-12)
        memory[at.MEMORY + k] *= 1.0 - inside / (inside + left + 1e-12)
        heights[k] -= slice_
        cut += slice_
    mass = cut * numbers[tm.DENSITY] * numbers[tm.WIDTH] * tm.SPACING
    full = memory[at.PAYLOAD] / numbers[tm.CAPACITY]
    # The fuller the bucket, the more soil flows past it onto the heap.
    loaded = min(mass * max(1.0 - full * full, 0.0), max(numbers[tm.CAPACITY] - memory[at.PAYLOAD], 0.0))
    memory[at.PAYLOAD] += loaded
    memory[at.HEAP] += mass - loaded
    over = memory[at.HEAP] - numbers[tm.HEAP_LIMIT]
    if over > 0.0:
        memory[at.HEAP] -= over
        drop(over, x - DROP_CELLS * tm.SPACING, 4, numbers, heights)


@compiled
def move_back(h: float, v: tuple[float, float, float, float], c: Array, ground: tuple[Array, ...]) -> None:
    """Move soil in front of the back in a step, and soil displaced by the heel when it leaves."""
    numbers, heights, memory = ground[0], ground[3], ground[4]
    if c[tm.ON] > 0.0 and c[tm.PUSH_DEPTH] > 0.0:
        moved = h * (v[0] if c[tm.POINTS + 1] <= c[tm.POINTS + 3] else v[2])
        if moved > 0.0:
            if c[tm.DEPTH] <= 0.0:
                memory[at.DISTANCE] += moved
            bucket_back.push(c[tm.POINTS : tm.POINTS + 4], moved, numbers[tm.BACK], heights, memory)
    if c[tm.HEEL_DEPTH] <= 0.0 and memory[at.HEEL_SET] > 0.0:
        bucket_back.shove_aside(c[tm.POINTS + 2], memory[at.HEEL_SET], heights, memory)


@compiled
def settle(state: Array, h: float, c: Array, ground: tuple[Array, ...]) -> None:
    """Complete a step: forces for the log, distance and shear, swept soil, chassis."""
    numbers, heights, memory = ground[0], ground[3], ground[4]
    v = tm.velocities(c, state[at.RATE], state[at.RATE + 1], state[at.RATE + 2])
    force = (0.0, 0.0, 0.0, 0.0)
    if c[tm.ON] > 0.0:
        force = tm.forces(c, v)
        memory[at.TOUCHED] = 1.0
        moved = h * math.sqrt(v[0] * v[0] + v[1] * v[1])
        if c[tm.DEPTH] > 0.0:
            memory[at.IN_SOIL] = 1.0
            memory[at.DISTANCE] += moved
            # E: chips break every 0.9 of the depth, between 0.6 and 1.2
            chip = memory[at.CHIP] + moved / max(0.9 * c[tm.DEPTH], 0.03)
            memory[at.CHIP] = chip - math.floor(chip)
            into = v[0] * c[tm.EDGE_X] + v[1] * c[tm.EDGE_Y]
            # Only a drag towards the machine, edge first, fills the bucket.
            if v[0] < 0.0 and into > 0.0:
                sweep(c, -h * v[0], numbers, heights, memory)
        if numbers[tm.BACK] > 0.0:
            move_back(h, v, c, ground)
        if c[tm.HEEL_DEPTH] > 0.0:
            slid = h * abs(v[2])
            memory[at.SHEAR] += slid
            # Sliding brings fresh soil below the heel, which has no set yet.
            memory[at.HEEL_SET] *= math.exp(-slid / (2.0 * tm.HEEL_CONTACT))
        else:
            memory[at.SHEAR] = memory[at.HEEL_SET] = 0.0
        damping = 1.0
    else:
        damping = 0.0
        if numbers[tm.BACK] > 0.0:
            move_back(h, v, c, ground)
        memory[at.SHEAR] = memory[at.HEEL_SET] = 0.0
    # A margin above the ground: an edge that skims the surface would begin a dig at each touch.
    if memory[at.IN_SOIL] > 0.0 and c[tm.DEPTH] < -LEFT_M:
        memory[at.IN_SOIL] = 0.0
        memory[at.DIGS] += 1.0
        drop(memory[at.HEAP], c[tm.POINTS] - tm.SPACING, 6, numbers, heights)
        memory[at.HEAP] = 0.0
    memory[at.FORCE_X], memory[at.FORCE_Y] = force[0] + force[2], force[1] + force[3]
    tm.rock(h, numbers, memory, c, force, damping)


@compiled
def spill(angle: float, x: float, time_s: float, numbers: Array, heights: Array, memory: Array) -> None:
    """Let soil slide out of a bucket in the air that is tilted too far; `angle`: its attitude, `x`: its place."""
    # Distance of the attitude from -pi, where the mouth is level, whatever turn it is counted in.
    turn = (angle + math.pi) / (2.0 * math.pi)
    tilt = 2.0 * math.pi * abs(turn - math.floor(turn + 0.5))
    holds = min(max((EMPTY_RAD - tilt) / (EMPTY_RAD - HOLDS_RAD), 0.0), 1.0) * numbers[tm.CAPACITY]
    over = memory[at.PAYLOAD] - holds
    if over > 0.0:
        # The last 100 g leave at once: an exponential decay would never end.
        gone = over * min(time_s / SPILL_S, 1.0) if over > 0.1 else over
        memory[at.PAYLOAD] -= gone
        drop(gone, x + 2.0 * tm.SPACING, 5, numbers, heights)


@compiled
def slide(x: float, numbers: Array, heights: Array) -> None:
    """Let soil slide on slopes around `x` that are too steep, forwards and backwards once."""
    middle = cell_of(x, heights)
    # 1.2 m to either side of the edge: soil is moved nowhere else.
    first, last = max(middle - 24, 0), min(middle + 24, heights.shape[0] - 1)
    limit = numbers[tm.STEEPEST] * tm.SPACING
    for n in range(2 * (last - first)):
        k = first + n if n < last - first else 2 * last - first - 1 - n
        rise = heights[k + 1] - heights[k]
        if abs(rise) > limit:
            # Half of the excess goes to each side, so that the mass stays.
            move = 0.5 * (rise - limit if rise > 0.0 else rise + limit)
            heights[k] += move
            heights[k + 1] -= move


@compiled
def carry(numbers: Array, memory: Array, axes: Array) -> None:
    """Compute mass, centre and inertia of the bucket with its load."""
    own, load = numbers[tm.BUCKET_MASS], memory[at.PAYLOAD]
    mass = own + load
    x = (own * numbers[tm.BUCKET_X] + load * numbers[tm.LOAD_X]) / mass
    y = (own * numbers[tm.BUCKET_Y] + load * numbers[tm.LOAD_Y]) / mass
    own_x, own_y = numbers[tm.BUCKET_X] - x, numbers[tm.BUCKET_Y] - y
    load_x, load_y = numbers[tm.LOAD_X] - x, numbers[tm.LOAD_Y] - y
    spread = 0.25 * load / numbers[tm.DENSITY] * numbers[tm.SWELL] / numbers[tm.WIDTH]
    axes[2, at.MASS], axes[2, at.COM_X], axes[2, at.COM_Y] = mass, x, y
    inertia = numbers[tm.BUCKET_INERTIA] + own * (own_x * own_x + own_y * own_y)
    axes[2, at.INERTIA] = inertia + load * (load_x * load_x + load_y * load_y + spread)


@compiled
def look(row: Array, time_s: float, axes: Array, ground: tuple[Array, ...]) -> tuple[bool, bool]:
    """Advance spilling, sliding and carrying of soil by one sample.

    Returns whether the bucket may touch soil within the next sample, and whether this may be its first contact.

    Args:
        row: the sample's log.
        time_s: length of a sample.
        axes: parameters of the cylinders, whose bucket takes the load.
        ground: the arrays of the ground.
    """
    numbers, heights, memory = ground[0], ground[3], ground[4]
    x, y, angle = row[at.LOG_TIP], row[at.LOG_TIP + 1], row[at.LOG_TIP + 2]
    length = numbers[tm.FLOOR_LENGTH]
    floor_x = -(math.cos(angle) * numbers[tm.FLOOR_COS] + math.sin(angle) * numbers[tm.FLOOR_SIN])
    floor_y = -(math.sin(angle) * numbers[tm.FLOOR_COS] - math.cos(angle) * numbers[tm.FLOOR_SIN])
    pitch = memory[at.PITCH]
    low, top = min(y, y + length * floor_y) + pitch * x, -1e9
    first, last = cell_of(min(x, x + length * floor_x), heights), cell_of(max(x, x + length * floor_x), heights)
    for k in range(max(first - 3, 0), min(last + 4, heights.shape[0])):
        top = max(top, heights[k])
    gap = low - top
    boom, arm = row[at.PSI], row[at.PSI] + row[at.PSI + 1]
    elbow = axes[0, at.LENGTH] * math.cos(boom)
    pin = elbow + axes[1, at.LENGTH] * math.cos(arm)
    down = -x * row[at.RATE] - (x - elbow) * row[at.RATE + 1] - (x - pin) * row[at.RATE + 2]
    rocking = abs(pitch) > 1e-6 or abs(memory[at.PITCH_RATE]) > 1e-6
    inside = memory[at.IN_SOIL] > 0.0
    near = gap < NEAR_M or rocking or inside
    if not inside and memory[at.PAYLOAD] > 0.0:
        spill(angle, x - 0.5 * axes[2, at.LENGTH] * math.cos(angle), time_s, numbers, heights, memory)
    if near:
        slide(x, numbers, heights)
        if numbers[tm.BACK] > 0.0:
            # The back pushes soil ahead of the heel, a floor's length away.
            slide(max(x, x + length * floor_x), numbers, heights)
    else:
        memory[at.FORCE_X] = memory[at.FORCE_Y] = memory[at.PITCH] = memory[at.PITCH_RATE] = 0.0
    carry(numbers, memory, axes)
    untouched = row[at.LOG_EVENTS + at.SOIL_CONTACT] == 0.0
    # 1.5 samples of the present sinking and 2 mm: the landing itself must fall into fine steps.
    return near, near and untouched and down > LANDING and gap < 0.002 + 1.5 * down * time_s
