"""Compiled ground contact of a grey box with a known linkage: tip position, depth and holding forces.

Within one sample a ground force acts as a damper with the coefficient force / speed. The force opposes the motion or is
perpendicular to it, so that the ground never adds energy for any parameters of its law.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import jit
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.linkage import joint_angle
from edp.storage.machine_code import Compiler

Array = NDArray[np.float64]
# Kept on disk apart: no plan waits for it.
compiler = Compiler("grey_ground", lambda: (*jit.compiler.sources(), Path(__file__)))
compiled, inner = compiler.compiled, compiler.inner
CELL_M = 0.05
"""Cell size of the ground profile, m."""
AHEAD_M = 0.075
"""Distance ahead of the bucket edge at which the uncut ground height is read, m. The cell of the edge itself is already
cut."""
CREEP = 0.02
"""Speed (m/s) over which the direction of a ground force is smoothed."""
TURNING = 0.05
"""Speed (m/s) over which a ground force changes from the value of one direction to that of the opposite direction."""
EDGE_M = 0.05
"""Depth at which the whole bucket edge is in the ground, m."""
INWARDS, OUTWARDS, DOWN, UP, ACROSS = 0, 3, 6, 9, 12
"""Index of the first ground parameter of each direction. Each direction has three parameters (edge, by depth, by depth
squared); ``ACROSS`` has one (by depth)."""
NUMBERS = 13
"""Number of ground parameters. The ground forces are linear in them."""
ROUNDS = 4
"""Number of fixed-point iterations between the velocity at the end of a sample and the damping at this velocity."""


@inner
def tip_at(linkage: Array, bucket_m: float, strokes: Array, tip: Array, slopes: Array) -> None:
    """Place of the tip in the frame of the boom foot, and its slopes by the strokes.

    Args:
        linkage: linkage of `parameter_index`.
        bucket_m: length of the last body, m.
        strokes: ``(actuator,)``, m.
        tip: result: position of the tip ``(2,)``, m.
        slopes: result: derivatives of the position by the strokes, ``(2, actuator)``.
    """
    slopes[:] = 0.0
    x, y, angle = 0.0, 0.0, 0.0
    for a in range(at.BODIES):
        joint = at.JOINTS + a * at.JOINT_VALUES
        psi, _, _, _ = joint_angle(linkage, joint, strokes[int(linkage[joint + at.ACTUATOR])])
        angle += psi
        length = bucket_m if a == at.BODIES - 1 else linkage[at.LENGTH + a]
        x += length * math.cos(angle)
        y += length * math.sin(angle)
    tip[0], tip[1] = x, y
    x, y, angle = 0.0, 0.0, 0.0
    for a in range(at.BODIES):
        joint = at.JOINTS + a * at.JOINT_VALUES
        which = int(linkage[joint + at.ACTUATOR])
        psi, turn, _, _ = joint_angle(linkage, joint, strokes[which])
        # A joint turns everything behind it about itself.
        slopes[0, which], slopes[1, which] = -turn * (tip[1] - y), turn * (tip[0] - x)
        angle += psi
        length = bucket_m if a == at.BODIES - 1 else linkage[at.LENGTH + a]
        x += length * math.cos(angle)
        y += length * math.sin(angle)


@inner
def height_at(x: float, profile: Array) -> float:
    """Return the height (m) of the ground at `x`, linear between its cells."""
    cell = min(max(x / CELL_M, 0.0), len(profile) - 1.000001)
    k = int(cell)
    return float(profile[k] + (cell - k) * (profile[k + 1] - profile[k]))


@inner
def share(speed: float) -> float:
    """Return the fraction of motion towards smaller values, 0 to 1."""
    return min(max(0.5 - 0.5 * speed / TURNING, 0.0), 1.0)


@inner
def depth_at(tip: Array, v_x: float, profile: Array) -> float:
    """Return the depth (m) of the tip below the ground before it."""
    inward = share(v_x)
    uncut = inward * height_at(tip[0] - AHEAD_M, profile) + (1.0 - inward) * height_at(tip[0] + AHEAD_M, profile)
    return float(uncut - tip[1])


@inner
def size_of(numbers: Array, first: int, depth: float) -> float:
    """Force (N) of one direction at a depth (m)."""
    return float(
        numbers[first] * min(depth / EDGE_M, 1.0) + numbers[first + 1] * depth + numbers[first + 2] * depth * depth
    )


@inner
def dampers(numbers: Array, depth: float, v_x: float, v_y: float) -> tuple[float, float, float]:
    """Return along x, along y and across, N s/m, of a tip at a depth below ground (m) and at a velocity (m/s)."""
    if depth <= 0.0:
        return 0.0, 0.0, 0.0
    slow = 1.0 / math.sqrt(v_x * v_x + v_y * v_y + CREEP * CREEP)
    inward, down = share(v_x), share(v_y)
    along = inward * size_of(numbers, INWARDS, depth) + (1.0 - inward) * size_of(numbers, OUTWARDS, depth)
    upright = down * size_of(numbers, DOWN, depth) + (1.0 - down) * size_of(numbers, UP, depth)
    return slow * along, slow * upright, slow * inward * numbers[ACROSS] * depth


@inner
def cut(before: float, tip: Array, profile: Array) -> None:
    """Lower the ground that an edge has passed since it was at `before`, towards the machine."""
    first, last = int(tip[0] / CELL_M + 0.5), int(before / CELL_M + 0.5)
    for k in range(max(first, 0), min(last + 1, len(profile))):
        profile[k] = min(profile[k], tip[1])


@compiled
def hold(
    front: tuple[Array, float],
    strokes: Array,
    free: Array,
    slopes: Array,
    numbers: Array,
    memory: tuple[Array, Array],
    forces: Array,
) -> None:
    """Compute the forces against the cylinders that match the velocity at the end of a sample.

    Args:
        front: linkage and length of the bucket, as `tip_at` reads them.
        strokes: strokes before the sample ``(actuator,)``, m.
        free: velocities after it without any ground ``(actuator,)``, m/s.
        slopes: derivatives of the velocities by a force against each actuator ``(actuator, actuator)``, m/s per N.
        numbers: parameters of the law ``(NUMBERS,)``.
        memory: profile, which is cut, and x of the tip before ``(1,)``.
        forces: result: ground forces ``(actuator,)``, N.
    """
    profile, last = memory
    n = len(strokes)
    tip, by = np.empty(2), np.empty((2, n))
    tip_at(front[0], front[1], strokes, tip, by)
    if last[0] > tip[0]:
        cut(last[0], tip, profile)
    last[0] = tip[0]
    w_x, w_y = 0.0, 0.0
    gives = np.zeros((2, 2))
    for i in range(n):
        w_x += by[0, i] * free[i]
        w_y += by[1, i] * free[i]
        for j in range(n):
            for a in range(2):
                for b in range(2):
                    gives[a, b] -= by[a, i] * slopes[i, j] * by[b, j]
    free_x, free_y, f_x, f_y = w_x, w_y, 0.0, 0.0
    for _ in range(ROUNDS):
        d_x, d_y, across = dampers(numbers, depth_at(tip, w_x, profile), w_x, w_y)
        # (1 + gives D) w = free, D = [[d_x, across], [-across, d_y]].
        xx, xy = 1.0 + gives[0, 0] * d_x - gives[0, 1] * across, gives[0, 0] * across + gives[0, 1] * d_y
        yx, yy = gives[1, 0] * d_x - gives[1, 1] * across, 1.0 + gives[1, 0] * across + gives[1, 1] * d_y
        whole = xx * yy - xy * yx
        w_x, w_y = (yy * free_x - xy * free_y) / whole, (xx * free_y - yx * free_x) / whole
        f_x, f_y = d_x * w_x + across * w_y, d_y * w_y - across * w_x
    for i in range(n):
        forces[i] = by[0, i] * f_x + by[1, i] * f_y


@compiled
def follow(
    front: tuple[Array, float],
    strokes: Array,
    velocities: Array,
    profile: Array,
    tips: Array,
    terms: Array,
) -> None:
    """Compute depth and speed of the tip along a log, and the cylinder forces of each law parameter.

    Args:
        front: geometry, see `hold`.
        strokes: ``(tick, actuator)``, m.
        velocities: ``(tick, actuator)``, m/s.
        profile: cut along the log.
        tips: result: depth (m) and speed (m/s) of the tip ``(tick, 2)``.
        terms: result: force per unit of each ground parameter ``(tick, NUMBERS, actuator)``, N.
    """
    ticks, n = strokes.shape
    tip, by, one = np.empty(2), np.empty((2, n)), np.zeros(NUMBERS)
    last = 0.0
    for t in range(ticks):
        tip_at(front[0], front[1], strokes[t], tip, by)
        if t > 0 and last > tip[0]:
            cut(last, tip, profile)
        last = tip[0]
        w_x, w_y = 0.0, 0.0
        for i in range(n):
            w_x += by[0, i] * velocities[t, i]
            w_y += by[1, i] * velocities[t, i]
        tips[t, 0], tips[t, 1] = depth_at(tip, w_x, profile), math.sqrt(w_x * w_x + w_y * w_y)
        for k in range(NUMBERS):
            one[:] = 0.0
            one[k] = 1.0
            d_x, d_y, across = dampers(one, tips[t, 0], w_x, w_y)
            for i in range(n):
                terms[t, k, i] = by[0, i] * (d_x * w_x + across * w_y) + by[1, i] * (d_y * w_y - across * w_x)


@compiled
def touches(front: tuple[Array, float], strokes: Array, free: Array, profile: Array) -> bool:
    """Return whether the tip may be in the ground; arguments as in `hold` and `follow`."""
    tip, by, w_x = np.empty(2), np.empty((2, len(strokes))), 0.0
    tip_at(front[0], front[1], strokes, tip, by)
    for i in range(len(strokes)):
        w_x += by[0, i] * free[i]
    return depth_at(tip, w_x, profile) > 0.0
