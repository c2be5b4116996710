"""Worn pins: the force through them, and how a joint moves against its cylinder within their play."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import dynamics, friction, linkage
from edp.sim.physics.jit import compiled, inlined

Array = NDArray[np.float64]
FILM = 4e5
"""Squeeze-film damping of the grease in a pin, N s/m; E: 12 pi mu L (R / c)^3 of a full journal, with mu 1 Pa s, L 0.1
m, R 35 mm and c 0.75 mm."""
PARTS = 10
"""Number of substeps of a step in which the pin play is crossed."""


@compiled
def fill_levers(angles: Array, plant: Array, out: Array) -> None:
    """Compute lever arms J = dx/dpsi in m/rad at joint angles, both of shape (time, 3)."""
    for k in range(angles.shape[0]):
        for i in range(at.AXES):
            out[k, i] = linkage.cylinder(i, angles[k, i], plant)[1]


@compiled
def fill_loads(log: Array, axes: Array, plant: Array, force: Array, mass: Array) -> None:
    """Force that each cylinder puts on its joint through the pins, N, and the mass it moves, M_ii / J^2, kg.

    Hydraulic force less the seals' friction plus the end stop, as the plant has them; `force` and `mass` of shape
    (time, 3) are filled.
    """
    for k in range(log.shape[0]):
        arm, bucket = log[k, at.PSI + 1], log[k, at.PSI + 2]
        c12, _, c13, _, c23, _ = dynamics.couplings(
            math.cos(arm), math.sin(arm), math.cos(bucket), math.sin(bucket), axes
        )
        m11, _, _, m22, _, m33 = dynamics.mass_terms(c12, c13, c23, axes)
        inertia = (m11, m22, m33)
        for i in range(at.AXES):
            v = log[k, at.LOG_VELOCITY + i]
            drag = friction.lugre(v, log[k, at.BRISTLE + i], axes, i, axes[i, at.VISCOUS])[0]
            stop = friction.end_stop(log[k, at.LOG_STROKE + i], v, axes, i)[0]
            hydraulic = axes[i, at.HEAD_AREA] * log[k, at.HEAD + i] - axes[i, at.ROD_AREA] * log[k, at.ROD + i]
            lever = linkage.cylinder(i, log[k, at.PSI + i], plant)[1]
            force[k, i] = hydraulic - drag + stop
            mass[k, i] = inertia[i] / (lever * lever)


@inlined
def cross_play(
    pull: tuple[float, float], mass: float, half: float, step_s: float, before: tuple[float, float]
) -> tuple[float, float]:
    """Return the offset (m) and speed (m/s) of a pin in its bore after a sample, from those before it.

    `pull` contains the force at the beginning and at the end of the sample; `half` is half of the play.
    """
    part = step_s / PARTS
    pin_offset, speed = before
    for n in range(PARTS):
        # Midpoint rule: the force is linear between samples.
        share = (n + 0.5) / PARTS
        force = pull[0] + share * (pull[1] - pull[0])
        # Implicit in the grease: stable for however light a mass behind the pin.
        speed = (speed - force / mass * part) / (1.0 + FILM / mass * part)
        pin_offset += speed * part
        if abs(pin_offset) >= half:
            pin_offset = half if pin_offset > 0.0 else -half
            speed = 0.0
    return pin_offset, speed


@inlined
def first_offset(force: float, half: float) -> float:
    """Return the initial pin offset: on the side to which its force pushes."""
    return -half if force >= 0.0 else half


@compiled
def follow_play(force: Array, mass: Array, width: Array, step_s: float, out: Array) -> None:
    """Write the velocity of each joint relative to its cylinder within the pin play, m/s, shape (time, 3), to `out`.

    A pin that pushes lies half of `width` (m) ahead of its bore. Once the force turns, no force passes until the play
    is crossed: against a cylinder without play the joint is then accelerated by -force / mass, and held back by the
    grease, `FILM`. It does not bounce.
    Mean velocity since the previous sample, so that its integral is the travel within the play.
    """
    for i in range(force.shape[1]):
        half = 0.5 * width[i]
        pin_offset, speed = first_offset(force[0, i], half), 0.0
        out[0, i] = 0.0
        for k in range(1, force.shape[0]):
            before = pin_offset
            pull = (force[k - 1, i], force[k, i])
            pin_offset, speed = cross_play(pull, mass[k, i], half, step_s, (before, speed))
            out[k, i] = (pin_offset - before) / step_s


def lever_arms(angles: Array, plant: Array) -> Array:
    """Return the lever arms J = dx/dpsi in m/rad at joint angles, shape (time, 3)."""
    out = np.empty_like(angles)
    fill_levers(np.ascontiguousarray(angles), plant, out)
    return out


def play_velocity(force: Array, mass: Array, width: Array, step_s: float) -> Array:
    """See `follow_play`; shape (time, 3)."""
    out = np.zeros_like(force)
    if width.any():
        follow_play(force, mass, width, step_s, out)
    return out


def loads(log: Array, axes: Array, plant: Array) -> tuple[Array, Array]:
    """Force through the pins and mass behind them; see `fill_loads`."""
    force, mass = np.empty((len(log), at.AXES)), np.empty((len(log), at.AXES))
    fill_loads(log, axes, plant, force, mass)
    return force, mass
