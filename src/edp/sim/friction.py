"""LuGre friction of a cylinder, and its Hunt-Crossley end stops."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import layout as at
from edp.sim.jit import compiled

Array = NDArray[np.float64]


@compiled
def lugre(v: float, z: float, cylinder: Array) -> tuple[float, float, float, float, float, float]:
    """LuGre friction with bristle damping that fades with speed (which keeps it passive).

    Args:
        v: cylinder velocity, m/s.
        z: bristle deflection, m.
        cylinder: the cylinder's row of `axes`.

    Returns:
        Friction force (N), bristle rate (m/s), and the derivatives: force by z, force by v, rate by z, rate by v.
    """
    ratio = v / cylinder[at.STRIBECK]
    fade = math.exp(-ratio * ratio)
    level = cylinder[at.COULOMB] + (cylinder[at.STATIC] - cylinder[at.COULOMB]) * fade
    fade_slope = -2.0 * ratio / cylinder[at.STRIBECK] * fade
    level_slope = (cylinder[at.STATIC] - cylinder[at.COULOMB]) * fade_slope
    stiffness, damping = cylinder[at.SIGMA0], cylinder[at.SIGMA1] * fade
    sign = 1.0 if v >= 0.0 else -1.0
    decay = stiffness * abs(v) / level
    z_rate = v - decay * z
    rate_by_v = 1.0 - stiffness * z * (sign - abs(v) * level_slope / level) / level
    force = stiffness * z + damping * z_rate + cylinder[at.VISCOUS] * v
    force_by_z = stiffness - damping * decay
    force_by_v = damping * rate_by_v + cylinder[at.SIGMA1] * fade_slope * z_rate + cylinder[at.VISCOUS]
    return force, z_rate, force_by_z, force_by_v, -decay, rate_by_v


@compiled
def end_stop(stroke: float, v: float, cylinder: Array) -> tuple[float, float]:
    """Hunt-Crossley stop force (N, extension positive) and its derivative by velocity; it pushes, never pulls."""
    if stroke < 0.0:
        depth, inward = -stroke, -v
    elif stroke > cylinder[at.STROKE]:
        depth, inward = stroke - cylinder[at.STROKE], v
    else:
        return 0.0, 0.0
    factor = 1.0 + cylinder[at.STOP_DAMPING] * inward
    if factor <= 0.0:
        return 0.0, 0.0
    force = cylinder[at.STOP_STIFFNESS] * depth * factor
    slope = -cylinder[at.STOP_STIFFNESS] * depth * cylinder[at.STOP_DAMPING]
    return (force if stroke < 0.0 else -force), slope
