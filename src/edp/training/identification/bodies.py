"""Rigid bodies from the load of a grey box: joint inertia and gravity torque over the poses of the logs.

Both are linear in nine numbers, in which masses, centres of gravity and inertias enter (base parameters)::

    X_1 = m_1 x_1 + (m_2 + m_3) L_1   X_2 = m_2 x_2 + m_3 L_2   X_3 = m_3 x_3   Y_i = m_i y_i
    H_1 = I_1 + m_1 r_1^2 + (m_2 + m_3) L_1^2   H_2 = I_2 + m_2 r_2^2 + m_3 L_2^2   H_3 = I_3 + m_3 r_3^2

So masses are not told apart from where they sit: of all bodies with these nine numbers the ones are taken whose
proportions are nearest to those of the guess. The linkage's pins and lengths are the guess's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.networks.twin.grey.parameter_index import BODY_VALUES
from edp.networks.twin.grey.parameters import ParameterTable
from edp.sim.machine import layout as sim
from edp.sim.machine.machine import Bodies, Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import linkage
from edp.wording import typed

Doubles = NDArray[np.float64]
NAMES = ("X_1", "Y_1", "X_2", "Y_2", "X_3", "Y_3", "H_1", "H_2", "H_3")
GIGA, MEGA = 1e6, 1e6
"""From Gg to kg, and from MN to N."""
TORQUE_TRUST, INERTIA_TRUST = 0.01, 0.1
"""Errors of gravity and inertia, as shares of their size: forces in steady state are measured, inertia follows from
swings."""
GUESS_TRUST = 1.0
"""Deviation of the nine numbers from those of the guess, as a share of their size: it decides where nothing moved."""
NEAR = (0.7, 0.1, 0.1, 0.3)
"""Plausible deviations of masses (logarithm), centres of gravity (shares of length) and inertias (logarithm)."""
MAX_POSES = 300


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the logs.

    Attributes:
        strokes: ``(pose, 3)``, m.
        angles: relative joint angles ``(pose, 3)``, rad.
        levers: dx/dpsi of each cylinder ``(pose, 3)``, m/rad.
    """

    strokes: Doubles
    angles: Doubles
    levers: Doubles

    @staticmethod
    def from_strokes(machine: Machine, strokes: Doubles) -> Poses:
        """Return angles and lever arms at strokes ``(pose, 3)``; at most `MAX_POSES`, evenly chosen."""
        axes, plant = pack(machine)
        chosen = strokes[:: max(1, -(-len(strokes) // MAX_POSES))]
        chosen = np.clip(chosen, 0.0, axes[:, sim.STROKE])
        angles = np.array(
            [[linkage.angle_at_stroke(i, stroke, axes, plant) for i, stroke in enumerate(row)] for row in chosen]
        )
        levers = np.array([[linkage.cylinder(i, psi, plant)[1] for i, psi in enumerate(row)] for row in angles])
        return Poses(chosen, angles, levers)


def base_parameters(bodies: Bodies) -> Doubles:
    """Return the nine base parameters of bodies, in the order of `NAMES`."""
    m, x, y, i = (np.array(values) for values in (bodies.mass, bodies.com_x, bodies.com_y, bodies.inertia))
    behind = np.array([m[1] + m[2], m[2], 0.0])
    length = np.array(bodies.length)
    first, second = m * x + behind * length, i + m * (x * x + y * y) + behind * length**2
    return np.array([first[0], m[0] * y[0], first[1], m[1] * y[1], first[2], m[2] * y[2], *second])


def load_by_base(poses: Poses, lengths: Sequence[float], gravity: float) -> tuple[Doubles, Doubles]:
    """Return gravity torques ``(pose, 3, 9)`` and joint inertia ``(pose, 3, 3, 9)`` per base parameter."""
    count = len(poses.angles)
    absolute, (_, second, third) = np.cumsum(poses.angles, axis=1), poses.angles.T
    torque, inertia = np.zeros((count, 3, 9)), np.zeros((count, 3, 3, 9))
    for body in range(3):
        own = gravity * np.stack([np.cos(absolute[:, body]), -np.sin(absolute[:, body])], axis=1)
        # A body turns with its own joint and with those before it.
        torque[:, : body + 1, 2 * body : 2 * body + 2] = own[:, None]
        inertia[:, : body + 1, : body + 1, 6 + body] = 1.0
    pairs = ((0, 1, second, lengths[0]), (0, 2, second + third, lengths[0]), (1, 2, third, lengths[1]))
    for near, far, angle, length in pairs:
        coupling = length * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        for a in range(far + 1):
            for b in range(far + 1):
                # Of both bodies' velocities where a joint turns both, of the farther one's alone behind the near one.
                times = (a <= near) + (b <= near)
                inertia[:, a, b, 2 * far : 2 * far + 2] += times * coupling
    return torque, inertia


def grey_load(
    table: ParameterTable, load: Doubles, z_of: tuple[Doubles, Doubles], poses: Poses
) -> tuple[Doubles, Doubles]:
    """Return the gravity torques ``(pose, 3)``, N m, and joint inertia ``(pose, 3, 3)``, kg m^2, of a grey box.

    Args:
        table: parameter table of the grey box.
        load: parameters of the load, in the units of the grey box.
        z_of: middle and scale of the strokes.
        poses: poses to evaluate.
    """
    z, n, terms = (poses.strokes - z_of[0]) * z_of[1], poses.strokes.shape[1], table.inertia_terms
    value = np.prod(z[:, None] ** table.exponents, axis=2)
    low, first = np.zeros((len(z), n, n)), 0
    for a in range(n):
        for c in range(a + 1):
            low[:, a, c] = value[:, :terms] @ load[first : first + terms]
            first += terms
    potential = load[table.potential_at - table.inertia_at :]
    pull = np.empty((len(z), n))
    for i in range(n):
        lower = np.maximum(table.exponents - (np.arange(n) == i), 0)
        slope = table.exponents[:, i] * z_of[1][i] * np.prod(z[:, None] ** lower, axis=2)
        pull[:, i] = slope[:, 1:] @ potential
    lever = poses.levers
    inertia = low @ low.transpose(0, 2, 1) * GIGA
    return pull * MEGA * lever, inertia * lever[:, :, None] * lever[:, None]


def solve_base(torque: Doubles, inertia: Doubles, poses: Poses, guess: Machine) -> Doubles:
    """Return the nine base parameters that best match gravity torques and joint inertia over the poses.

    Args:
        torque: ``(pose, 3)``.
        inertia: ``(pose, 3, 3)``.
        poses: poses of torques and inertia.
        guess: machine whose lengths hold, and whose bodies decide where the poses tell nothing.
    """
    by_torque, by_inertia = load_by_base(poses, guess.bodies.length, guess.gravity)
    begin = base_parameters(guess.bodies)
    torque_size = TORQUE_TRUST * np.sqrt(np.square(torque).mean(axis=0))
    diagonal = np.sqrt(np.square(np.diagonal(inertia, axis1=1, axis2=2)).mean(axis=0))
    inertia_size = INERTIA_TRUST * np.sqrt(diagonal[:, None] * diagonal)
    rows = [(by_torque / torque_size[:, None]).reshape(-1, 9), (by_inertia / inertia_size[..., None]).reshape(-1, 9)]
    goals = [(torque / torque_size).reshape(-1), (inertia / inertia_size).reshape(-1)]
    # Rows of many poses say one thing: they count as one together.
    share = 1.0 / np.sqrt(len(poses.strokes))
    matrix = np.concatenate([share * np.concatenate(rows), np.diag(1.0 / (GUESS_TRUST * np.abs(begin)))])
    goal = np.concatenate([share * np.concatenate(goals), np.sign(begin) / GUESS_TRUST])
    size = np.abs(begin)
    return np.asarray(size * np.linalg.lstsq(matrix * size, goal, rcond=None)[0])


def read_bodies(load: Doubles, guess: Machine) -> Bodies:
    """Return the bodies of a grey box with a known linkage from its load parameters; lengths are the guess's."""
    mass, x, y, inertia = load.reshape(-1, BODY_VALUES).T * np.array([[GIGA], [1.0], [1.0], [GIGA]])
    return replace(guess.bodies, mass=_triple(mass), com_x=_triple(x), com_y=_triple(y), inertia=_triple(inertia))


def realise_bodies(base: Doubles, guess: Machine) -> Bodies:
    """Return bodies with these nine base parameters, in proportions as near to the guess's as possible.

    Raises:
        ConfigError: no masses give every body a positive inertia about its centre.
    """
    # Here, since scipy.optimize takes a second.
    from scipy.optimize import least_squares

    own = guess.bodies
    length = np.array(own.length)
    shape = np.concatenate([np.array(own.com_x) / length, np.array(own.com_y) / length])
    spin = np.array(own.inertia) / (np.array(own.mass) * length**2)

    def apart(logarithms: Doubles) -> Doubles:
        mass = np.array(own.mass) * np.exp(logarithms)
        x, y, inertia = _compute_centres(base, mass, length)
        share = inertia / (mass * length**2) / spin
        # A steep line below a tenth: what is negative is further away than any proportion, but finite.
        bent = np.where(share > 0.1, np.log(np.maximum(share, 0.1)), np.log(0.1) - 100.0 * (0.1 - share))
        moved = (np.concatenate([x / length, y / length]) - shape) / np.repeat(NEAR[1:3], 3)
        return np.concatenate([logarithms / NEAR[0], moved, bent / NEAR[3]])

    mass = np.array(own.mass) * np.exp(least_squares(apart, np.zeros(3), xtol=1e-14, ftol=1e-14, gtol=1e-14).x)
    x, y, inertia = _compute_centres(base, mass, length)
    if not (inertia > 0.0).all():
        worst = int(np.argmin(inertia))
        raise ConfigError(
            f"no rigid bodies have the joint inertia and gravity torques of the logs (the inertia of body {worst + 1} "
            f"about its centre would be {typed(inertia[worst])} kg m^2); check that pins, lengths and bores of "
            "--machine "
            "are those of the machine that was logged, and that the logs move every cylinder"
        )
    return replace(own, mass=_triple(mass), com_x=_triple(x), com_y=_triple(y), inertia=_triple(inertia))


def _compute_centres(base: Doubles, mass: Doubles, length: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Return the centres of gravity and inertias about them, of bodies with these masses."""
    behind = np.array([mass[1] + mass[2], mass[2], 0.0])
    x, y = (base[[0, 2, 4]] - behind * length) / mass, base[[1, 3, 5]] / mass
    return x, y, base[6:] - behind * length**2 - mass * (x * x + y * y)


def _triple(values: Doubles) -> tuple[float, float, float]:
    first, second, third = (float(value) for value in values)
    return first, second, third
