"""Automatic grading: straight passes of the tip at constant attitude."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import EXCITATIONS, Array
from edp.sim.excitation.tracking import Tracked
from edp.sim.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("grading")
class Grading(Tracked):
    """Cartesian lines at 0.1-0.5 m/s and constant attitude, back and forth, then a move to another line.

    Over ground the lines lie at its surface, a few centimetres in; in free air anywhere in reach.
    """

    by_hand = False
    works_ground = True
    PROPORTIONAL, INTEGRAL = 4.0, 2.0
    SPEED = (0.1, 0.5)
    LENGTH_M = (1.0, 4.5)
    SLOPE = 0.15
    """Largest rise over run of a line in free air."""
    BITE_M = (-0.02, 0.05)
    PASSES = (1, 4)
    TRIES = 60

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._from = np.zeros(3)
        self._to = np.zeros(3)
        self._passes = 0

    def next_leg(self, view: View) -> Array:
        """A pass over the line, or the move to the start of a new one."""
        if self._passes > 0:
            self._passes -= 1
            length = float(np.hypot(*(self._to - self._from)[:2]))
            leg = self.cartesian_leg(tuple(self._from), tuple(self._to), length / self._rng.uniform(*self.SPEED))
            self._from, self._to = self._to, self._from
            return leg
        for _ in range(self.TRIES):
            strokes = self._rng.uniform(0.1, 0.9, 3)
            x, y, attitude = self.kinematics.pose_at(strokes)
            along = self._rng.uniform(*self.LENGTH_M) * self._rng.choice([-1.0, 1.0])
            rise = along * self._rng.uniform(-self.SLOPE, self.SLOPE)
            if view.ground == view.ground:  # over ground: NaN is free air
                y, rise = view.ground - self._rng.uniform(*self.BITE_M), 0.0
            start, goal = (x, y, attitude), (x + along, y + rise, attitude)
            if x > 0.0 and self.line_fits(start, goal):
                self._from, self._to = np.array(start), np.array(goal)
                self._passes = int(self._rng.integers(self.PASSES[0], self.PASSES[1] + 1))
                there = self.kinematics.strokes_at(*start)
                if there is not None:
                    return self.stroke_leg(there, self._rng.uniform(0.1, 0.3))
        # nothing fits from here: stretch towards the middle, and try again from there
        return self.stroke_leg(self._rng.uniform(0.35, 0.65, 3), 0.2)
