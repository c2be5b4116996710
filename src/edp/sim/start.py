"""Start of a scenario: seeds, ground, and initial pose of the machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose, soil
from edp.sim.physics.material import load_material
from edp.sim.scenario import Scenario

Array = NDArray[np.float64]
START_CLEARANCE_M, START_TRIES = 0.3, 100
"""Minimum height of the tip above ground at the start (m), and maximum number of random strokes that are tried to reach
it."""


def seeds_of(scenario: Scenario) -> list[np.random.SeedSequence]:
    """Return the seeds of start, operator, sensors, soil and faults, in this order."""
    # The order is fixed: another one would give other recordings for the same seed.
    return np.random.SeedSequence(scenario.seed).spawn(5)


def start_of(scenario: Scenario, machine: Machine) -> tuple[soil.Ground | None, Array]:
    """Return the ground (None in free air) and the initial strokes (fractions of full stroke, shape (3,))."""
    start, _, _, course, _ = seeds_of(scenario)
    ground = None
    if scenario.material:
        material = load_material(scenario.material)
        ground = soil.Ground(material, machine, np.random.default_rng(course))
    return ground, _start_strokes(scenario, machine, ground, np.random.default_rng(start))


def _start_strokes(scenario: Scenario, machine: Machine, ground: soil.Ground | None, rng: np.random.Generator) -> Array:
    """Return strokes (fractions of full stroke) near the middle with the bucket clear of the ground."""
    strokes = rng.uniform(*scenario.start_strokes, 3)
    if ground is None:
        return strokes
    kinematics = pose.Kinematics(*pack(machine))
    for _ in range(START_TRIES):
        x, y, _ = kinematics.pose_at(strokes)
        if y > ground.height(x) + START_CLEARANCE_M:
            break
        strokes = rng.uniform(*scenario.start_strokes, 3)
        # A raised boom clears most grounds.
        strokes[0] = rng.uniform(scenario.start_strokes[1], 0.9)
    return strokes
