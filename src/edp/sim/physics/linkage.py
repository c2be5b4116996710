"""Cylinder length and lever arm as functions of the joint angle: two pin triangles and the bucket's four-bar."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import compiled, inlined

Array = NDArray[np.float64]


@inlined
def pin_triangle(base: float, rod: float, cosine: float, sine: float) -> tuple[float, float]:
    """Return the length (m) between the pins and its derivative by the angle (m/rad), by the cosine law."""
    length = math.sqrt(base * base + rod * rod - 2.0 * base * rod * cosine)
    return length, base * rod * sine / length


@inlined
def bucket_linkage(cosine: float, sine: float, plant: Array) -> tuple[float, float]:
    """Return the bucket cylinder length (m) and its derivative by the bucket angle (m/rad), given cosine and sine.

    The rocker pin is where the circles of rocker and link meet, on the cylinder's side of the line from the rocker
    pivot to the lug. Constant link length gives the rocker's rate: (E - D) . D' = (E - D) . E_theta theta_r'.
    """
    lug_dx = plant[at.LUG_X] * cosine - plant[at.LUG_Y] * sine
    lug_dy = plant[at.LUG_X] * sine + plant[at.LUG_Y] * cosine
    to_lug_x = plant[at.PIN_X] + lug_dx - plant[at.PIVOT_X]
    to_lug_y = lug_dy - plant[at.PIVOT_Y]
    inverse = 1.0 / (to_lug_x * to_lug_x + to_lug_y * to_lug_y)
    rocker2, link2 = plant[at.ROCKER] * plant[at.ROCKER], plant[at.LINK] * plant[at.LINK]
    along = 0.5 * (1.0 + (rocker2 - link2) * inverse)
    # Rounding makes the radicand negative where rocker and link align; zero would divide the lever arm by zero.
    across = math.sqrt(max(rocker2 * inverse - along * along, 1e-12))
    arm_x = along * to_lug_x - across * to_lug_y
    arm_y = along * to_lug_y + across * to_lug_x
    link_x, link_y = arm_x - to_lug_x, arm_y - to_lug_y
    cylinder_x = plant[at.PIVOT_X] + arm_x - plant[at.CYLINDER_X]
    cylinder_y = plant[at.PIVOT_Y] + arm_y - plant[at.CYLINDER_Y]
    length = math.sqrt(cylinder_x * cylinder_x + cylinder_y * cylinder_y)
    turned = (link_y * lug_dx - link_x * lug_dy) * (cylinder_y * arm_x - cylinder_x * arm_y)
    return length, turned / ((link_y * arm_x - link_x * arm_y) * length)


@inlined
def cylinder_at(axis: int, cosine: float, sine: float, plant: Array) -> tuple[float, float]:
    """Return `cylinder` from cosine and sine of the joint angle."""
    if axis == 0:
        c, s = plant[at.BOOM_COS], plant[at.BOOM_SIN]
        return pin_triangle(plant[at.BOOM_BASE], plant[at.BOOM_ROD], cosine * c - sine * s, sine * c + cosine * s)
    if axis == 1:
        c, s = plant[at.ARM_COS], plant[at.ARM_SIN]
        length, slope = pin_triangle(
            plant[at.ARM_BASE], plant[at.ARM_ROD], cosine * c + sine * s, cosine * s - sine * c
        )
        return length, -slope
    return bucket_linkage(cosine, sine, plant)


@compiled
def cylinder(axis: int, psi: float, plant: Array) -> tuple[float, float]:
    """Return the pin-to-pin length (m) of one cylinder and J = dx/dpsi (m/rad), thesis eq. 3.7 (J is diagonal)."""
    return cylinder_at(axis, math.cos(psi), math.sin(psi), plant)


def bucket_closes(psi: Array, plant: Array) -> NDArray[np.bool_]:
    """Return whether rocker and link meet at these bucket angles (rad)."""
    angle = psi + plant[at.LUG_ANGLE]
    across = plant[at.PIN_X] + plant[at.LUG] * np.cos(angle) - plant[at.PIVOT_X]
    apart = np.hypot(across, plant[at.LUG] * np.sin(angle) - plant[at.PIVOT_Y])
    folded, straight = abs(plant[at.ROCKER] - plant[at.LINK]), plant[at.ROCKER] + plant[at.LINK]
    # A micrometre away from both limits, where rocker and link align and the lever arm is not defined.
    return np.asarray((apart > folded + 1e-6) & (apart < straight - 1e-6))


@compiled
def _tabulate(psi: Array, selected: NDArray[np.bool_], plant: Array, length: Array, lever: Array) -> None:
    """Compute the bucket cylinder's length and lever arm at the selected angles."""
    for k in range(psi.shape[0]):
        if selected[k]:
            length[k], lever[k] = cylinder(2, psi[k], plant)


def bucket_branch(closed: float, full: float, plant: Array) -> tuple[Array, Array]:
    """Return angles (rad, rising) and lengths (m, falling) of the working range of the bucket cylinder.

    Of all segments of angles on which the linkage closes and the cylinder shortens as the angle grows, the one that
    covers most of the lengths from `closed` to `full`; empty when there is none.
    """
    # One full turn in steps of 0.2 deg.
    psi = np.linspace(-1.3 * np.pi, 0.7 * np.pi, 1801)
    length, lever = np.full(len(psi), np.nan), np.full(len(psi), np.nan)
    _tabulate(psi, bucket_closes(psi, plant), plant, length, lever)
    # Padded, so that a stretch which touches an end of the range has both its edges.
    falling = np.concatenate(([False], lever < 0.0, [False]))
    edges = np.flatnonzero(np.diff(falling.astype(int))).reshape(-1, 2)

    def covered(edge: NDArray[np.int_]) -> float:
        part = length[edge[0] : edge[1]]
        return float(min(part.max(), full) - max(part.min(), closed))

    if not len(edges):
        return psi[:0], length[:0]
    first, last = max(edges, key=covered)
    return psi[first:last], length[first:last]


def angle_at_stroke(axis: int, stroke: float, axes: Array, plant: Array) -> float:
    """Return the joint angle (rad) at a stroke (m from closed): the cosine law, or bisection for the bucket."""
    target = stroke + axes[axis, at.CLOSED]
    if axis < 2:
        base, rod, offset = ((at.BOOM_BASE, at.BOOM_ROD, at.BOOM_OFFSET), (at.ARM_BASE, at.ARM_ROD, at.ARM_OFFSET))[
            axis
        ]
        cosine = (plant[base] ** 2 + plant[rod] ** 2 - target**2) / (2.0 * plant[base] * plant[rod])
        # Rounding at the ends of the stroke can take the cosine just beyond 1.
        phi = math.acos(min(max(cosine, -1.0), 1.0))
        return float(phi - plant[offset] if axis == 0 else plant[offset] - phi)
    psi, _ = bucket_branch(axes[axis, at.CLOSED], axes[axis, at.CLOSED] + axes[axis, at.STROKE], plant)
    # Bisection, since the length falls all along the branch: Newton's method could leave it near a stop.
    low, high = psi[0], psi[-1]
    # 60 halvings of a turn end below the spacing of float64.
    for _ in range(60):
        middle = 0.5 * (low + high)
        if cylinder(2, middle, plant)[0] > target:
            low = middle
        else:
            high = middle
    return float(0.5 * (low + high))
