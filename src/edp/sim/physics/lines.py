"""Long lines between valves and cylinders: their oil has inertia, compressibility and wall friction.

A lumped line (pi section; Merritt, Hydraulic Control Systems, 1967; Watton, Fluid Power Systems, 1989) of length L,
bore d and area A = pi d^2 / 4. Half of its volume V lies at the valve, half belongs to the chamber:

    C(p_v) p_v' = Q_valve - q,   I q' = p_v - p_c - drop(q),   (chamber + V / 2)(p_c) p_c' = q - A_piston v

with C = V / 2 (1 / beta(p) + 1 / K), K the bulk modulus of its wall, I = rho L / A, and the drop by Hagen and
Poiseuille, 128 mu L q / (pi d^4), or by Blasius' friction factor 0.3164 Re^(-1/4), whichever is larger: they meet at
Re = 1187. The viscosity follows the oil's temperature. Reliefs, make-up valves and leakage to tank sit at the valve,
the piston's leakage between the chambers. One section represents the slowest mode of a line. Travelling waves above
(beta / rho)^(1/2) / (4 L), about 40 Hz for 8 m, are not represented.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Cylinders, Machine
from edp.sim.physics.jit import inlined

Array = NDArray[np.float64]
DENSITY = 860.0
"""Density of mineral oil of the viscosity grade in the machine files, kg/m^3."""


def modelled(cylinders: Cylinders) -> bool:
    """Return whether a machine has lines of their own."""
    return any(cylinders.line_bore)


def lengths(cylinders: Cylinders) -> Array:
    """Return the length (m) of each cylinder's line of this volume and bore, shape (3,)."""
    return np.array(cylinders.hose_volume) / (math.pi / 4.0 * np.array(cylinders.line_bore) ** 2)


def pack_lines(machine: Machine, axes: Array) -> None:
    """Write the line parameters at 40 degC into `axes`."""
    cylinders = machine.cylinders
    bore, length = np.array(cylinders.line_bore), lengths(cylinders)
    area = math.pi / 4.0 * bore**2
    viscosity = machine.oil.viscosity
    axes[:, at.PORT_VOLUME] = 0.5 * np.array(cylinders.hose_volume)
    for i, modulus in enumerate(cylinders.line_modulus):
        axes[i, at.LINE_WALL] = axes[i, at.PORT_VOLUME] / modulus if modulus > 0.0 else 0.0
    axes[:, at.LINE_INERTANCE] = DENSITY * length / area
    axes[:, at.LINE_LAMINAR] = 128.0 * DENSITY * viscosity * length / (math.pi * bore**4)
    # 0.3164 (v d / nu)^(-1/4) L / d rho v^2 / 2 with v = q / A
    axes[:, at.LINE_TURBULENT] = 0.3164 * (viscosity / bore) ** 0.25 * length / bore * 0.5 * DENSITY * area ** (-1.75)


@inlined
def drop(flow: float, i: int, axes: Array, plant: Array) -> tuple[float, float]:
    """Return the pressure (Pa) lost along a line of cylinder `i` at a flow (m^3/s), and its slope (> 0)."""
    # Viscosity is that of 40 degC over `THINNING`.
    viscous = axes[i, at.LINE_LAMINAR] / plant[at.THINNING]
    root = math.sqrt(abs(flow))
    rough = axes[i, at.LINE_TURBULENT] * root * math.sqrt(root) / math.sqrt(math.sqrt(plant[at.THINNING]))
    if rough > viscous:
        return rough * flow, 1.75 * rough
    return viscous * flow, viscous


@inlined
def first_valve_pressure(plant: Array) -> int:
    """Return the first state of the pressures (heads, then rods) that the valve's sections see."""
    return at.PORT_HEAD if plant[at.LINES] > 0.0 else at.HEAD


def rest(state: Array, plant: Array) -> None:
    """Set the oil in the lines to zero flow at the chamber pressures."""
    if plant[at.LINES] > 0.0:
        state[at.PORT_HEAD : at.PORT_HEAD + 2 * at.AXES] = state[at.HEAD : at.HEAD + 2 * at.AXES]
        state[at.FLOW_HEAD : at.FLOW_HEAD + 2 * at.AXES] = 0.0
