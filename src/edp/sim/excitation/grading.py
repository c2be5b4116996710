"""Automatic grading: straight passes of the tip at constant attitude."""

from __future__ import annotations

import math

import numpy as np

from edp.sim.excitation.base import EXCITATIONS, Array
from edp.sim.excitation.tracking import Tracked
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("grading")
class Grading(Tracked):
    """Cartesian lines at 0.1-0.5 m/s and constant attitude, back and forth, then a move to another line.

    Over ground the lines lie at its surface, a few centimetres in; in free air anywhere in reach.
    """

    by_hand = False
    works_ground = True
    PROPORTIONAL, INTEGRAL = 4.0, 2.0
    """Controller gains, 1/s and 1/s^2. Among proportional gains of 2 to 5 /s, 4 /s has the smallest errors; at 5 /s the
    levers change sign twice as often (journal)."""
    SPEED = (0.1, 0.5)
    LENGTH_M = (1.0, 4.5)
    SLOPE = 0.15
    """Maximum slope (rise over run) of a line in free air."""
    BITE_M = (-0.02, 0.05)
    PASSES = (1, 4)
    TRIES = 60
    ABOVE_M, LIFT_S = 0.4, 1.5
    """Height (m) at which the tip moves between lines over ground, and time (s) to reach this height."""
    NEAREST = 0.25
    """Distance of the nearest point of a line, as a fraction of the machine's reach."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._from = np.zeros(3)
        self._to = np.zeros(3)
        self._passes, self._raised = 0, True

    def next_leg(self, view: View) -> Array:
        """Return a pass over the line, or the way to a new one: up, across, and down to it."""
        rng = self._rng
        if self._passes > 0:
            self._raised = False
            x, y, attitude = self.reference_pose()
            # The reference is above the start of the line, so the tip moves down first.
            if np.hypot(x - self._from[0], y - self._from[1]) > 0.05:
                return self.cartesian_leg((x, y, attitude), tuple(self._from), self.LIFT_S)
            self._passes -= 1
            length = float(np.hypot(*(self._to - self._from)[:2]))
            leg = self.cartesian_leg(tuple(self._from), tuple(self._to), length / rng.uniform(*self.SPEED))
            self._from, self._to = self._to, self._from
            return leg
        over_ground = not math.isnan(view.ground)
        if over_ground and not self._raised:
            self._raised = True
            x, y, attitude = self.reference_pose()
            up = (x, y + self.ABOVE_M, attitude)
            return self.cartesian_leg((x, y, attitude), up, self.LIFT_S) if self._reaches(up) else self._lift(view)
        for _ in range(self.TRIES):
            there = self._choose(view)
            if there is not None and (not over_ground or self.stays_above(there, view.ground + 0.1)):
                self._passes = int(rng.integers(self.PASSES[0], self.PASSES[1] + 1))
                return self.stroke_leg(there, rng.uniform(0.1, 0.3))
        # nothing fits from here: try again from elsewhere
        return self._lift(view) if over_ground else self.stroke_leg(rng.uniform(0.35, 0.65, 3), 0.2)

    def _choose(self, view: View) -> Array | None:
        """Draw a line; strokes at (over ground: above) its start, or None where it does not fit."""
        rng = self._rng
        x, y, attitude = self.kinematics.pose_at(rng.uniform(0.1, 0.9, 3))
        along = rng.uniform(*self.LENGTH_M) * rng.choice([-1.0, 1.0])
        rise, above = along * rng.uniform(-self.SLOPE, self.SLOPE), 0.0
        if not math.isnan(view.ground):
            y, rise, above = view.ground - rng.uniform(*self.BITE_M), 0.0, self.ABOVE_M
        self._from, self._to = np.array([x, y, attitude]), np.array([x + along, y + rise, attitude])
        # Cheap test first: `line_fits` solves the linkage seven times.
        if min(x, x + along) < self.NEAREST * self.reach_m or not self.line_fits(tuple(self._from), tuple(self._to)):
            return None
        return self.kinematics.strokes_at(x, y + above, attitude)

    def _reaches(self, tip: tuple[float, float, float]) -> bool:
        return self.kinematics.strokes_at(*tip) is not None

    def _lift(self, view: View) -> Array:
        goal = view.strokes.copy()
        goal[0] = min(goal[0] + self.RESCUE, 0.95)
        goal[1:] = np.clip(goal[1:] + self._rng.uniform(-0.2, 0.2, 2), 0.1, 0.9)
        return self.stroke_leg(goal, 0.2)
