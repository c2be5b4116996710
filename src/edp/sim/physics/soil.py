"""Soil: the ground of one recording."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics import ground_profile, terramechanics
from edp.sim.physics.material import Material

Array = NDArray[np.float64]
SPACING_M = ground_profile.SPACING
"""Cell size of the height profile, m."""
BEYOND_M = 1.0
"""Distance by which the ground extends beyond the machine's reach, m."""
UNEVENNESS_M = 0.04
"""Standard deviation of the surface height at its support points, which are one metre apart, m."""


class Ground:
    """Ground in front of one machine: height profile along its reach, load in the bucket, and soil parameters.

    Heights are of soil at bank density, so that the mass of soil in profile, heap and bucket stays the same; the
    surface lies lower where the heel has pressed it.

    Args:
        material: soil.
        machine: machine whose bucket digs; defines height of the boom foot and reach.
        rng: random generator for unevenness, strength, stones and resistance, which are all generated at once.
    """

    spacing_m = SPACING_M
    start_m = 0.0

    def __init__(self, material: Material, machine: Machine, rng: np.random.Generator) -> None:
        self.material = material
        points = math.ceil((sum(machine.bodies.length) + BEYOND_M) / SPACING_M)
        # A bend each metre (20 cells) and two more, so that the interpolation has a value beyond either end.
        bends = rng.normal(0.0, UNEVENNESS_M, points // 20 + 2)
        uneven = np.interp(np.arange(points) / 20.0, np.arange(len(bends)), bends)
        # The origin is the boom foot, which stands above level ground.
        self.heights: Array = uneven - machine.chassis.boom_foot_height
        # Behind what one contact remembers: the depth of the rut at each point.
        self.memory: Array = np.zeros(at.MEMORY + points)
        self.numbers = terramechanics.pack_soil(material, machine, rng.uniform(*material.cone_index))
        self.tables = terramechanics.cutting_table(material)
        self.course = terramechanics.draw_course(material, rng)

    @property
    def payload_kg(self) -> float:
        """Soil in the bucket."""
        return float(self.memory[at.PAYLOAD])

    @property
    def ruts_m(self) -> Array:
        """Depth of the rut at each point of the profile, live."""
        return self.memory[at.MEMORY :]

    @property
    def mass_kg(self) -> float:
        """All soil: profile (above 0 of the boom-foot frame counts positive), heap before the edge, bucket."""
        profile = self.material.density * self.numbers[terramechanics.WIDTH] * SPACING_M * float(self.heights.sum())
        result: float = profile + float(self.memory[at.HEAP] + self.memory[at.PAYLOAD])
        return result

    def height(self, x: float) -> float:
        """Return the height (m above the boom foot) at a distance (m) in front of the boom foot."""
        return float(terramechanics.height_at(x - self.start_m, self.heights - self.ruts_m))

    def redraw(self, rng: np.random.Generator) -> None:
        """Redraw the resistance of soil not yet reached; soil at the cutting edge continues from its present value."""
        redraw_course(self.material, self.numbers, self.memory, self.course, rng)

    def arrays(self) -> tuple[Array, ...]:
        """Return the arrays of the compiled code: parameters, tables, resistance profile, heights, memory."""
        return self.numbers, self.tables, self.course, self.heights, self.memory


def no_ground() -> tuple[Array, ...]:
    """Return the arrays of `Ground.arrays` for free air."""
    return np.zeros(terramechanics.NUMBERS), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2), np.zeros(at.MEMORY + 2)


def redraw_course(material: Material, numbers: Array, memory: Array, course: Array, rng: np.random.Generator) -> None:
    """Redraw the part of `course` not yet reached, in place; see `Ground.redraw`."""
    old = course.copy()
    fresh = terramechanics.draw_course(material, rng)
    count = len(old)
    # The unit process forgets its present value over a few cells: fresh[0] is independent, so it is bridged.
    here = int(memory[at.DISTANCE] / numbers[terramechanics.COURSE_STEP])
    keep = np.exp(-np.arange(count) / 8.0)
    ahead = (here + np.arange(count)) % count
    course[ahead, 0] = keep * old[here % count, 0] + np.sqrt(1.0 - keep**2) * fresh[:, 0]
    stone = (int(memory[at.DISTANCE] / terramechanics.STONE_STEP) + np.arange(count)) % count
    # A stone in contact with the edge stays until the edge has passed it.
    inside = np.logical_and.accumulate(old[stone, 1] > 0.0)
    course[stone, 1] = np.where(inside, old[stone, 1], fresh[:, 1])
    # The strength of the present dig was already felt; that of the later ones was not.
    dig = int(memory[at.DIGS]) % count
    course[:, 2] = fresh[:, 2]
    course[dig, 2] = old[dig, 2]
