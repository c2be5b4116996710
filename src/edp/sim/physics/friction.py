"""LuGre friction of a cylinder, and its Hunt-Crossley end stops."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]
NEGLIGIBLE = 6.5
"""Multiple of the Stribeck velocity beyond which its effect, exp(-42), is below rounding."""


@inlined
def lugre(v: float, z: float, axes: Array, i: int, viscous: float) -> tuple[float, float, float, float, float, float]:
    """Return LuGre friction with a bristle damping that decreases with speed, which keeps it passive.

    Args:
        v: cylinder velocity, m/s.
        z: bristle deflection, m.
        axes: parameters of all cylinders.
        i: index of the cylinder.
        viscous: viscous friction at the oil's temperature, N s/m.

    Returns:
        Friction force (N), bristle rate (m/s), and the derivatives: force by z, force by v, rate by z, rate by v.
    """
    ratio = v / axes[i, at.STRIBECK]
    fade = math.exp(-ratio * ratio) if abs(ratio) < NEGLIGIBLE else 0.0
    level = axes[i, at.COULOMB] + (axes[i, at.STATIC] - axes[i, at.COULOMB]) * fade
    fade_slope = -2.0 * ratio / axes[i, at.STRIBECK] * fade
    level_slope = (axes[i, at.STATIC] - axes[i, at.COULOMB]) * fade_slope
    stiffness, damping = axes[i, at.SIGMA0], axes[i, at.SIGMA1] * fade
    # d|v|/dv is one-sided at rest: the Jacobian needs a finite slope, and ROS2 keeps its order for any.
    sign = 1.0 if v >= 0.0 else -1.0
    decay = stiffness * abs(v) / level
    z_rate = v - decay * z
    rate_by_v = 1.0 - stiffness * z * (sign - abs(v) * level_slope / level) / level
    force = stiffness * z + damping * z_rate + viscous * v
    force_by_z = stiffness - damping * decay
    force_by_v = damping * rate_by_v + axes[i, at.SIGMA1] * fade_slope * z_rate + viscous
    return force, z_rate, force_by_z, force_by_v, -decay, rate_by_v


@inlined
def end_stop(stroke: float, v: float, axes: Array, i: int) -> tuple[float, float]:
    """Return the Hunt-Crossley stop force (N, extension positive) and its derivative by velocity; it never pulls."""
    if stroke < 0.0:
        depth, inward = -stroke, -v
    elif stroke > axes[i, at.STROKE]:
        depth, inward = stroke - axes[i, at.STROKE], v
    else:
        return 0.0, 0.0
    factor = 1.0 + axes[i, at.STOP_DAMPING] * inward
    # A rebound faster than 1 / damping would make Hunt and Crossley's law pull.
    if factor <= 0.0:
        return 0.0, 0.0
    force = axes[i, at.STOP_STIFFNESS] * depth * factor
    slope = -axes[i, at.STOP_STIFFNESS] * depth * axes[i, at.STOP_DAMPING]
    return (force if stroke < 0.0 else -force), slope
