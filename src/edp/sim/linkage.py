"""Cylinder length and lever arm as functions of the joint angle: two pin triangles and the bucket's four-bar."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import layout as at
from edp.sim.jit import compiled

Array = NDArray[np.float64]


@compiled
def pin_triangle(base: float, rod: float, phi: float) -> tuple[float, float]:
    """Length (m) between the pins and its derivative by `phi` (m/rad), by the cosine law."""
    length = math.sqrt(base * base + rod * rod - 2.0 * base * rod * math.cos(phi))
    return length, base * rod * math.sin(phi) / length


@compiled
def bucket_linkage(psi: float, plant: Array) -> tuple[float, float]:
    """Bucket cylinder length (m) and its derivative by the bucket angle (m/rad).

    The rocker pin is where the circles of rocker and link meet, on the cylinder's side of the line from the rocker
    pivot to the lug. Constant link length gives the rocker's rate: (E - D) . D' = (E - D) . E_theta theta_r'.
    """
    angle = psi + plant[at.LUG_ANGLE]
    lug_dx, lug_dy = plant[at.LUG] * math.cos(angle), plant[at.LUG] * math.sin(angle)
    to_lug_x = plant[at.PIN_X] + lug_dx - plant[at.PIVOT_X]
    to_lug_y = lug_dy - plant[at.PIVOT_Y]
    distance2 = to_lug_x * to_lug_x + to_lug_y * to_lug_y
    along = 0.5 * (1.0 + (plant[at.ROCKER] ** 2 - plant[at.LINK] ** 2) / distance2)
    across = math.sqrt(max(plant[at.ROCKER] ** 2 / distance2 - along * along, 1e-12))
    arm_x = along * to_lug_x - across * to_lug_y
    arm_y = along * to_lug_y + across * to_lug_x
    link_x, link_y = arm_x - to_lug_x, arm_y - to_lug_y
    rocker_rate = (link_y * lug_dx - link_x * lug_dy) / (link_y * arm_x - link_x * arm_y)
    cylinder_x = plant[at.PIVOT_X] + arm_x - plant[at.CYLINDER_X]
    cylinder_y = plant[at.PIVOT_Y] + arm_y - plant[at.CYLINDER_Y]
    length = math.sqrt(cylinder_x * cylinder_x + cylinder_y * cylinder_y)
    return length, rocker_rate * (cylinder_y * arm_x - cylinder_x * arm_y) / length


@compiled
def cylinder(axis: int, psi: float, plant: Array) -> tuple[float, float]:
    """Pin-to-pin length (m) of one cylinder and J = dx/dpsi (m/rad), thesis eq. 3.7 (J is diagonal)."""
    if axis == 0:
        return pin_triangle(plant[at.BOOM_BASE], plant[at.BOOM_ROD], psi + plant[at.BOOM_OFFSET])
    if axis == 1:
        length, slope = pin_triangle(plant[at.ARM_BASE], plant[at.ARM_ROD], plant[at.ARM_OFFSET] - psi)
        return length, -slope
    return bucket_linkage(psi, plant)


def angle_at_stroke(axis: int, stroke: float, axes: Array, plant: Array) -> float:
    """Joint angle (rad) at a stroke (m from closed), by bisection over the joint's working range."""
    low, high = ((-1.0, 1.25), (-2.75, -0.35), (-2.55, 0.65))[axis]
    target = stroke + axes[axis, at.CLOSED]
    rising = cylinder(axis, high, plant)[0] > cylinder(axis, low, plant)[0]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (cylinder(axis, middle, plant)[0] < target) == rising:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
