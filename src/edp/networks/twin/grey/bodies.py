"""Rigid bodies of a linkage with data: their moments and inertias, and the forces of a motion (linear in both)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.equations import Equations, GreyForm
from edp.networks.twin.grey.jit import compiled
from edp.networks.twin.grey.linkage import joint_actuators, joint_angle
from edp.networks.twin.grey.program import ANGLES, ExpressionAlgebra, load_module
from edp.networks.twin.symbolic.expression import ExpressionGraph
from edp.networks.twin.symbolic.machine_code import CodeModule, Loaded, call

Array = NDArray[np.float64]
PARAMETERS = at.BODIES * at.BODY_VALUES


@dataclass(frozen=True, eq=False)
class BodyMoments:
    """First moments X, Y and inertia H of each body about its joint, see `Equations.moments`.

    Attributes:
        values: X, Y, H of each body, shape (BASE,).
        slopes: derivatives by the masses, centres of mass and inertias, shape (BASE, body parameter).
    """

    values: Array
    slopes: Array


@cache
def _functions(joints: tuple[int, ...]) -> Loaded:
    graph, n = ExpressionGraph(), len(joints)
    parameters, constants = graph.inputs("parameter", PARAMETERS), graph.inputs("constant", 2 * n + at.JOINTS)
    inputs = graph.inputs("input", 3 * n + ANGLES * n + at.BASE)
    strokes, speeds, accelerations = inputs[:n], inputs[n : 2 * n], inputs[2 * n : 3 * n]
    angles, moments = inputs[3 * n : 3 * n + ANGLES * n], inputs[3 * n + ANGLES * n :]
    for a, actuator in enumerate(joints):
        graph.link(angles[ANGLES * a : ANGLES * (a + 1)], strokes[actuator])
    form = GreyForm(
        valve_at=(), valve_actuator=(), valve_pump=(), actuator_at=(0,) * n, pump_at=(), circuit_at=0, inertia_at=0,
        inertia_terms=0, potential_at=PARAMETERS, exponents=(), joint_actuators=joints, knots=(), parameters=PARAMETERS,
    )  # fmt: skip
    algebra = ExpressionAlgebra(graph)
    equations, module = (
        Equations(form, parameters, constants, algebra),
        CodeModule(graph, (parameters, constants, inputs)),
    )
    values = equations.moments()
    slopes = algebra.derivatives(values, parameters)
    module.add("moments", [*values, *(slope for row in slopes for slope in row)])
    forces = equations.balance(moments, strokes, speeds, accelerations, angles[::ANGLES])
    module.add("balance", [slope for row in algebra.derivatives(forces, moments) for slope in row])
    return load_module(module, ("bodies", joints))


def moments_of(values: Array, inertia_at: int, linkage: Array) -> BodyMoments:
    """Return the moments and inertias of the bodies.

    Args:
        values: parameters of the grey box, shape (parameter,).
        inertia_at: index of the first body parameter.
        linkage: geometry of the linkage, see `edp.networks.twin.grey.parameter_index`.
    """
    joints = tuple(joint_actuators(linkage).tolist())
    bodies = np.ascontiguousarray(values[inertia_at : inertia_at + PARAMETERS])
    results = np.empty(at.BASE * (1 + PARAMETERS))
    constants = np.concatenate([np.zeros(2 * len(joints)), linkage[: at.JOINTS]])
    _call(_functions(joints).addresses["moments"], bodies, constants, np.zeros(1), results)
    return BodyMoments(results[: at.BASE], results[at.BASE :].reshape(at.BASE, PARAMETERS))


def forces_by_moments(strokes: Array, speeds: Array, accelerations: Array, linkage: Array) -> Array:
    """Return the derivatives of the actuator forces by each moment and inertia, shape (row, actuator, BASE).

    Args:
        strokes: m, shape (row, actuator).
        speeds: m/s, shape (row, actuator).
        accelerations: m/s^2, shape (row, actuator).
        linkage: geometry of the linkage, see `edp.networks.twin.grey.parameter_index`.
    """
    joints = joint_actuators(linkage)
    motion = np.ascontiguousarray(np.concatenate([strokes, speeds, accelerations], axis=1))
    forces = np.empty((*strokes.shape, at.BASE))
    constants = np.concatenate([np.zeros(2 * len(joints)), linkage[: at.JOINTS]])
    _balance(_functions(tuple(joints.tolist())).addresses["balance"], constants, linkage, motion, forces)
    return forces


@compiled
def _call(address: int, parameters: Array, constants: Array, inputs: Array, results: Array) -> None:
    call(address, parameters, constants, inputs, results)


@compiled
def _balance(address: int, constants: Array, linkage: Array, motion: Array, forces: Array) -> None:
    n = forces.shape[1]
    inputs, results = np.zeros(3 * n + ANGLES * n + at.BASE), np.empty(n * at.BASE)
    for row in range(len(motion)):
        for k in range(3 * n):
            inputs[k] = motion[row, k]
        for a in range(at.BODIES):
            joint, first = at.JOINTS + a * at.JOINT_VALUES, 3 * n + ANGLES * a
            stroke = inputs[int(linkage[joint + at.ACTUATOR])]
            inputs[first], inputs[first + 1], inputs[first + 2], inputs[first + 3] = joint_angle(linkage, joint, stroke)
        call(address, inputs, constants, inputs, results)
        for i in range(n):
            for k in range(at.BASE):
                forces[row, i, k] = results[i * at.BASE + k]
