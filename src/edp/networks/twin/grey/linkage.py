"""The load of a grey box whose linkage is known: planar rigid bodies, each turned by one cylinder against the last.

Angles theta_a = psi_1 + ... + psi_a, where psi_a is a function of one stroke: quintic polynomials between knots, which
have angle, slope and curvature of the linkage there. With R = d theta / d s, the equations of Lagrange are::

    R' (A R v' + A gamma + c + g) = forces,   gamma_a = sum_{k <= a} psi_k'' v_k^2

A_aa = H_a and A_ab = L_a (X_b cos D - Y_b sin D), D = theta_b - theta_a for a < b; c are centrifugal torques by the
squares of d theta / dt, g_a = G (X_a cos theta_a - Y_a sin theta_a). All is linear in the moments X, Y and the inertias
H of `base_of`, so energy is neither made nor lost, whatever the bodies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.jit import inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BEYOND = 1.0
"""Fraction of a segment by which the polynomials continue outside the first and last knot. Farther outside, the angle
continues linearly, so that a simulation that leaves the stroke range stays finite."""


@inner
def joint_angle(linkage: Array, joint: int, stroke: float) -> tuple[float, float, float, float]:
    """Return the joint angle (rad) at a stroke (m), and its three derivatives by it.

    `joint` is where the joint's values begin.
    """
    low, high = 0, at.LINKAGE_KNOTS - 1
    while high - low > 1:
        middle = (low + high) // 2
        if linkage[joint + at.KNOT + at.KNOT_VALUES * middle] > stroke:
            high = middle
        else:
            low = middle
    k = joint + at.KNOT + at.KNOT_VALUES * low
    after = k + at.KNOT_VALUES
    width = linkage[after] - linkage[k]
    along = (stroke - linkage[k]) / width
    inside = min(max(along, -BEYOND), 1.0 + BEYOND)
    rise = linkage[after + 1] - linkage[k + 1]
    d_0, d_1 = linkage[k + 2] * width, linkage[after + 2] * width
    b_0, b_1 = linkage[k + 3] * width * width, linkage[after + 3] * width * width
    c_3 = 10.0 * rise - 6.0 * d_0 - 4.0 * d_1 - 1.5 * b_0 + 0.5 * b_1
    c_4 = -15.0 * rise + 8.0 * d_0 + 7.0 * d_1 + 1.5 * b_0 - b_1
    c_5 = 6.0 * rise - 3.0 * (d_0 + d_1) - 0.5 * (b_0 - b_1)
    u = inside
    value = linkage[k + 1] + u * (d_0 + u * (0.5 * b_0 + u * (c_3 + u * (c_4 + u * c_5))))
    first = (d_0 + u * (b_0 + u * (3.0 * c_3 + u * (4.0 * c_4 + u * 5.0 * c_5)))) / width
    outside = along - inside
    if outside != 0.0:
        return value + outside * width * first, first, 0.0, 0.0
    second = (b_0 + u * (6.0 * c_3 + u * (12.0 * c_4 + u * 20.0 * c_5))) / (width * width)
    third = (6.0 * c_3 + u * (24.0 * c_4 + u * 60.0 * c_5)) / (width * width * width)
    return value, first, second, third


def joint_actuators(linkage: Array) -> IntArray:
    """Return the actuator of each joint."""
    return linkage[at.JOINTS + at.ACTUATOR :: at.JOINT_VALUES].astype(np.int64)
