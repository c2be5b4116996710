"""Planar rigid bodies in relative joint angles: mass matrix, Coriolis and gravity, energy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]


@inlined
def couplings(
    c2: float, s2: float, c3: float, s3: float, axes: Array
) -> tuple[float, float, float, float, float, float]:
    """Return the off-diagonal terms of the mass matrix in absolute angles: k cos and k sin for (12), (13), (23).

    c2, s2, c3, s3: cosine and sine of the arm's and the bucket's relative angle.
    """
    m2, m3 = axes[1, at.MASS], axes[2, at.MASS]
    l1, l2 = axes[0, at.LENGTH], axes[1, at.LENGTH]
    x2, y2 = m2 * axes[1, at.COM_X] + m3 * l2, m2 * axes[1, at.COM_Y]
    x3, y3 = m3 * axes[2, at.COM_X], m3 * axes[2, at.COM_Y]
    c13, s13 = c2 * c3 - s2 * s3, s2 * c3 + c2 * s3
    return (
        l1 * (x2 * c2 - y2 * s2),
        l1 * (x2 * s2 + y2 * c2),
        l1 * (x3 * c13 - y3 * s13),
        l1 * (x3 * s13 + y3 * c13),
        l2 * (x3 * c3 - y3 * s3),
        l2 * (x3 * s3 + y3 * c3),
    )


@inlined
def mass_terms(c12: float, c13: float, c23: float, axes: Array) -> tuple[float, float, float, float, float, float]:
    """Return the mass matrix in relative joint angles, kg m^2, entries 11, 12, 13, 22, 23, 33.

    M = L' H L with a lower-triangular L of ones.
    """
    m2, m3 = axes[1, at.MASS], axes[2, at.MASS]
    l1, l2 = axes[0, at.LENGTH], axes[1, at.LENGTH]
    own_1 = axes[0, at.MASS] * (axes[0, at.COM_X] * axes[0, at.COM_X] + axes[0, at.COM_Y] * axes[0, at.COM_Y])
    own_2 = m2 * (axes[1, at.COM_X] * axes[1, at.COM_X] + axes[1, at.COM_Y] * axes[1, at.COM_Y])
    own_3 = m3 * (axes[2, at.COM_X] * axes[2, at.COM_X] + axes[2, at.COM_Y] * axes[2, at.COM_Y])
    h11 = own_1 + axes[0, at.INERTIA] + (m2 + m3) * l1 * l1
    h22 = own_2 + axes[1, at.INERTIA] + m3 * l2 * l2
    h33 = own_3 + axes[2, at.INERTIA]
    m22 = h22 + h33 + 2.0 * c23
    return (
        h11 + h22 + h33 + 2.0 * (c12 + c13 + c23),
        m22 + c12 + c13,
        h33 + c23 + c13,
        m22,
        h33 + c23,
        h33,
    )


@inlined
def gravity_terms(
    boom: tuple[float, float], arm: tuple[float, float], bucket: tuple[float, float], axes: Array, gravity: float
) -> tuple[float, float, float]:
    """Return the generalised gravity torques in relative angles, N m, from (cosine, sine) of the absolute angles."""
    m1, m2, m3 = axes[0, at.MASS], axes[1, at.MASS], axes[2, at.MASS]
    g3 = m3 * (axes[2, at.COM_X] * bucket[0] - axes[2, at.COM_Y] * bucket[1])
    g2 = m2 * (axes[1, at.COM_X] * arm[0] - axes[1, at.COM_Y] * arm[1]) + m3 * axes[1, at.LENGTH] * arm[0]
    g1 = m1 * (axes[0, at.COM_X] * boom[0] - axes[0, at.COM_Y] * boom[1])
    g1 += (m2 + m3) * axes[0, at.LENGTH] * boom[0]
    return gravity * (g1 + g2 + g3), gravity * (g2 + g3), gravity * g3


@inlined
def coriolis_terms(s12: float, s13: float, s23: float, w1: float, w2: float, w3: float) -> tuple[float, float, float]:
    """Return the Coriolis and centrifugal torques in relative angles, N m.

    From joint rates and the sines of `couplings`.
    """
    w2 += w1
    w3 += w2
    first, second, third = w1 * w1, w2 * w2, w3 * w3
    c1 = -s12 * second - s13 * third
    c2 = s12 * first - s23 * third
    c3 = s13 * first + s23 * second
    return c1 + c2 + c3, c2 + c3, c3


def _turn(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def mass_matrix(psi: Array, axes: Array, out: Array) -> None:
    """Return M(psi), shape (3, 3), kg m^2, in relative joint angles."""
    c12, _, c13, _, c23, _ = couplings(*_turn(psi[1]), *_turn(psi[2]), axes)
    m11, m12, m13, m22, m23, m33 = mass_terms(c12, c13, c23, axes)
    out[:] = [[m11, m12, m13], [m12, m22, m23], [m13, m23, m33]]


def gravity_torque(psi: Array, axes: Array, gravity: float, out: Array) -> None:
    """Return the generalised gravity torque in relative angles, shape (3,), N m."""
    boom, arm, bucket = (_turn(angle) for angle in np.cumsum(psi))
    out[:] = gravity_terms(boom, arm, bucket, axes, gravity)


def bias_torque(psi: Array, rate: Array, axes: Array, plant: Array) -> Array:
    """Return the Coriolis plus gravity torque h(psi, rate), shape (3,), N m."""
    gravity = np.empty(3)
    gravity_torque(psi, axes, plant[at.GRAVITY], gravity)
    _, s12, _, s13, _, s23 = couplings(*_turn(psi[1]), *_turn(psi[2]), axes)
    result: Array = gravity + np.array(coriolis_terms(s12, s13, s23, *rate))
    return result


def mechanical_energy(psi: Array, rate: Array, axes: Array, plant: Array) -> float:
    """Return the sum of kinetic and potential energy, J (zero height at the boom foot)."""
    mass = np.empty((3, 3))
    mass_matrix(psi, axes, mass)
    angles = np.cumsum(psi)
    joint_y = np.concatenate(([0.0], np.cumsum(axes[:2, at.LENGTH] * np.sin(angles[:2]))))
    height = joint_y + axes[:, at.COM_X] * np.sin(angles) + axes[:, at.COM_Y] * np.cos(angles)
    return float(0.5 * rate @ mass @ rate + plant[at.GRAVITY] * np.sum(axes[:, at.MASS] * height))
