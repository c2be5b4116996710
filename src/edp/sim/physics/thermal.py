"""Oil temperature: a thermal balance, and what follows it: bulk modulus, leakage, viscous friction."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import motors as places
from edp.sim.physics.jit import compiled
from edp.sim.physics.motors import Motors

Array = NDArray[np.float64]


@compiled
def set_temperature(celsius: float, plant: Array) -> None:
    """Set the oil temperature: leakage is proportional to 1 / viscosity, viscous friction to the root of viscosity."""
    plant[at.OIL_TEMPERATURE] = celsius
    # The modulus falls by 0.4 % a K; viscosity by 3.5 % a K about 40 degC, its root by half of that.
    plant[at.BULK_MODULUS] = plant[at.BULK_AT_45] * (1.0 - 0.004 * (celsius - 45.0))
    plant[at.THINNING] = math.exp(0.035 * (celsius - 40.0))
    plant[at.VISCOUS_SHARE] = math.exp(-0.0175 * (celsius - 40.0))


@compiled
def losses(row: Array, axes: Array, plant: Array, motors: Motors | None = None) -> float:
    """Return the hydraulic power (W) dissipated in the oil: pump shaft power minus power of pistons and motors.

    Args:
        row: one logged sample.
        axes: parameters of the cylinders.
        plant: parameters of the plant.
        motors: swing and travel at the same instant, where they move.
    """
    power = 0.0
    for m in range(2):
        # Theoretical flow, without the volumetric efficiency: leakage of the pumps heats the oil, too.
        power += plant[at.MAX_FLOW] * row[at.DISPLACEMENT + m] * max(row[at.PUMP + m], 0.0)
    for i in range(at.AXES):
        force = axes[i, at.HEAD_AREA] * row[at.HEAD + i] - axes[i, at.ROD_AREA] * row[at.ROD + i]
        power -= force * row[at.LOG_VELOCITY + i]
    if motors is not None:
        power -= places.power(motors)
    return power


@compiled
def warm(row: Array, axes: Array, plant: Array, time_s: float, motors: Motors | None = None) -> None:
    """Heat and cool the oil over `time_s`, and update its properties."""
    celsius = plant[at.OIL_TEMPERATURE]
    heat = losses(row, axes, plant, motors) - plant[at.COOLING] * (celsius - plant[at.AMBIENT])
    set_temperature(celsius + heat * time_s / plant[at.HEAT_CAPACITY], plant)
