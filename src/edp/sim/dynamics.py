"""Planar rigid bodies in relative joint angles: mass matrix, Coriolis and gravity, energy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim import layout as at
from edp.sim.jit import compiled

Array = NDArray[np.float64]


@compiled
def couplings(psi: Array, axes: Array) -> tuple[float, float, float, float, float, float]:
    """Off-diagonal terms of the mass matrix in absolute angles: k cos and k sin for (12), (13), (23)."""
    arm_m, bucket_m = axes[1, at.MASS], axes[2, at.MASS]
    boom_l, arm_l = axes[0, at.LENGTH], axes[1, at.LENGTH]
    arm_first = arm_m * boom_l * axes[1, at.COM_RADIUS]
    arm_angle = psi[1] + axes[1, at.COM_ANGLE]
    k_bucket = bucket_m * boom_l * arm_l
    c12 = arm_first * math.cos(arm_angle) + k_bucket * math.cos(psi[1])
    s12 = arm_first * math.sin(arm_angle) + k_bucket * math.sin(psi[1])
    bucket_angle = psi[2] + axes[2, at.COM_ANGLE]
    bucket_first = bucket_m * axes[2, at.COM_RADIUS]
    c13 = bucket_first * boom_l * math.cos(psi[1] + bucket_angle)
    s13 = bucket_first * boom_l * math.sin(psi[1] + bucket_angle)
    c23 = bucket_first * arm_l * math.cos(bucket_angle)
    s23 = bucket_first * arm_l * math.sin(bucket_angle)
    return c12, s12, c13, s13, c23, s23


@compiled
def mass_matrix(psi: Array, axes: Array, out: Array) -> None:
    """M(psi), shape (3, 3), kg m^2, in relative joint angles: L' H L with L the lower-triangular ones matrix."""
    m2, m3 = axes[1, at.MASS], axes[2, at.MASS]
    c12, _, c13, _, c23, _ = couplings(psi, axes)
    h11 = axes[0, at.MASS] * axes[0, at.COM_RADIUS] ** 2 + axes[0, at.INERTIA] + (m2 + m3) * axes[0, at.LENGTH] ** 2
    h22 = m2 * axes[1, at.COM_RADIUS] ** 2 + axes[1, at.INERTIA] + m3 * axes[1, at.LENGTH] ** 2
    h33 = m3 * axes[2, at.COM_RADIUS] ** 2 + axes[2, at.INERTIA]
    out[2, 2] = h33
    out[1, 2] = h33 + c23
    out[0, 2] = h33 + c23 + c13
    out[1, 1] = h22 + h33 + 2.0 * c23
    out[0, 1] = out[1, 1] + c12 + c13
    out[0, 0] = h11 + h22 + h33 + 2.0 * (c12 + c13 + c23)
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@compiled
def gravity_torque(psi: Array, axes: Array, gravity: float, out: Array) -> None:
    """Generalised gravity torque in relative angles, shape (3,), N m."""
    boom, arm = psi[0], psi[0] + psi[1]
    bucket = arm + psi[2]
    m2, m3 = axes[1, at.MASS], axes[2, at.MASS]
    g3 = gravity * m3 * axes[2, at.COM_RADIUS] * math.cos(bucket + axes[2, at.COM_ANGLE])
    g2 = m2 * axes[1, at.COM_RADIUS] * math.cos(arm + axes[1, at.COM_ANGLE]) + m3 * axes[1, at.LENGTH] * math.cos(arm)
    g1 = axes[0, at.MASS] * axes[0, at.COM_RADIUS] * math.cos(boom + axes[0, at.COM_ANGLE])
    g1 += (m2 + m3) * axes[0, at.LENGTH] * math.cos(boom)
    out[2] = g3
    out[1] = g3 + gravity * g2
    out[0] = out[1] + gravity * g1


@compiled
def coriolis_torque(terms: tuple[float, ...], rate: Array, out: Array) -> None:
    """Coriolis and centrifugal torque in relative angles from the terms of `couplings`, shape (3,), N m."""
    _, s12, _, s13, _, s23 = terms
    w1 = rate[0] * rate[0]
    w2 = (rate[0] + rate[1]) ** 2
    w3 = (rate[0] + rate[1] + rate[2]) ** 2
    c1 = -s12 * w2 - s13 * w3
    c2 = s12 * w1 - s23 * w3
    c3 = s13 * w1 + s23 * w2
    out[2] = c3
    out[1] = c2 + c3
    out[0] = c1 + c2 + c3


def bias_torque(psi: Array, rate: Array, axes: Array, plant: Array) -> Array:
    """Coriolis plus gravity torque h(psi, rate), shape (3,), N m."""
    gravity, coriolis = np.empty(3), np.empty(3)
    gravity_torque(psi, axes, plant[at.GRAVITY], gravity)
    coriolis_torque(couplings(psi, axes), rate, coriolis)
    return gravity + coriolis


def mechanical_energy(psi: Array, rate: Array, axes: Array, plant: Array) -> float:
    """Kinetic plus potential energy, J (zero height at the boom foot)."""
    mass = np.empty((3, 3))
    mass_matrix(psi, axes, mass)
    angles = np.cumsum(psi)
    joint_y = np.concatenate(([0.0], np.cumsum(axes[:2, at.LENGTH] * np.sin(angles[:2]))))
    height = joint_y + axes[:, at.COM_RADIUS] * np.sin(angles + axes[:, at.COM_ANGLE])
    return float(0.5 * rate @ mass @ rate + plant[at.GRAVITY] * np.sum(axes[:, at.MASS] * height))
