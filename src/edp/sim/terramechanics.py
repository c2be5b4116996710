"""Forces of soil on the bucket, and soil moved by it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from edp.sim.machine import Machine
    from edp.sim.soil import Material

Array = NDArray[np.float64]
(
    ACTIVE, WIDTH, DENSITY,
) = range(3)  # fmt: skip
NUMBERS = 3


def pack_soil(material: Material, machine: Machine, cone_index: float) -> Array:
    """Soil and bucket as numbers for the compiled code."""
    numbers = np.zeros(NUMBERS)
    numbers[[ACTIVE, WIDTH, DENSITY]] = 1.0, machine.bucket.width, material.density
    return numbers


def cutting_table(material: Material) -> Array:
    """Factors of the earthmoving equation by rake angle."""
    return np.zeros((2, 4))


def draw_course(material: Material, rng: np.random.Generator) -> Array:
    """The course of the resistance."""
    return np.zeros((2, 4))
