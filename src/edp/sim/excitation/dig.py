"""Dig cycles: approach and penetrate, drag, curl and lift, dump and return."""

from __future__ import annotations

import math

import numpy as np

from edp.sim import tip_control
from edp.sim.excitation.base import EXCITATIONS, Array
from edp.sim.excitation.tracking import Tracked
from edp.sim.machine.machine import Machine
from edp.sim.view import View

LOOSE_DENSITY = 1400.0
"""Density of loosened soil that the operator assumes to detect a full bucket, kg/m^3."""
APPROACH, PENETRATE, DRAG, CURL, DUMP = range(5)


@EXCITATIONS.register("dig")
class Dig(Tracked):
    """Dig cycles in four phases, closed loop on depth; without swing, dumped where the bucket was lifted.

    The operator lowers the open bucket to the surface and below it, drags it towards the machine at a chosen depth
    while closing it somewhat, curls and lifts, reaches out and dumps, and returns. Where the drag stalls the
    bucket is raised, as an operator does; a full bucket ends it. In free air the cycles follow a virtual surface that
    is drawn again for each cycle.
    """

    works_ground = True
    DRAG_SPEED = (0.25, 0.7)
    DEPTH_M = (0.08, 0.35)
    LENGTH_M = (1.2, 3.5)
    ENTRY_DEG = (-125.0, -85.0)
    """Angle of the bucket as it enters the ground, degrees; straight down is -90 degrees."""
    CLOSING_DEG = (15.0, 60.0)
    CURLED_DEG = (-215.0, -185.0)
    """Angle of a closed bucket, degrees."""
    MIME_M = (-2.5, 0.5)
    MOVE = (0.15, 0.4)
    LIFT_M, DUMP_M, ABOVE_M = (0.8, 2.2), (1.0, 2.8), 0.4
    """Height (m) of the bucket tip above the surface after lifting, at dumping, and before penetrating."""
    OPEN_DEG = (-125.0, -60.0)
    RELIEF_RATE = 0.12
    """Speed at which the bucket is raised when the drag stalls, m/s."""
    FULL = 0.9
    """Fill level at which the drag ends, as a fraction of a struck bucket."""
    TRIES = 60

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._phase = DUMP
        self._surface = 0.0
        self._depth = 0.0
        self._in = np.zeros(3)
        self._out = np.zeros(3)
        self._full_kg = self.FULL * machine.bucket.capacity * LOOSE_DENSITY

    def next_leg(self, view: View) -> Array:
        """Return the motion of the next phase."""
        rng = self._rng
        self._phase = APPROACH if self._phase == DUMP else self._phase + 1
        if self._phase == APPROACH:
            if not self._plan(view):
                self._phase = DUMP
                return self.stroke_leg(rng.uniform(0.35, 0.65, 3), 0.2)
            above = self.kinematics.strokes_at(self._in[0], self._in[1] + self._depth + self.ABOVE_M, self._in[2])
            return self.stroke_leg(np.full(3, 0.5) if above is None else above, rng.uniform(*self.MOVE))
        if self._phase == PENETRATE:
            # NaN is unlike itself: free air has no surface.
            if view.ground == view.ground:  # the real surface here, now that the bucket is above it
                shift = view.ground - self._depth - self._in[1]
                self._in[1] += shift
                self._out[1] += shift
            return self.cartesian_leg(self.reference_pose(), tuple(self._in), rng.uniform(0.8, 2.0) + self.RAMP_S)
        if self._phase == DRAG:
            length = abs(self._in[0] - self._out[0])
            return self.cartesian_leg(tuple(self._in), tuple(self._out), length / rng.uniform(*self.DRAG_SPEED))
        if self._phase == CURL:
            return self._curl(view)
        return self.stroke_leg(self._dump(view), rng.uniform(*self.MOVE))

    def _plan(self, view: View) -> bool:
        """Choose surface, depth and drag line; return False if no choice is within reach."""
        rng, reach = self._rng, self.reach_m
        for _ in range(self.TRIES):
            self._surface = view.ground if view.ground == view.ground else rng.uniform(*self.MIME_M)
            self._depth = rng.uniform(*self.DEPTH_M)
            y = self._surface - self._depth
            x = rng.uniform(0.5, 0.95) * reach
            entry = math.radians(rng.uniform(*self.ENTRY_DEG))
            closing = math.radians(rng.uniform(*self.CLOSING_DEG))
            self._in = np.array([x, y, entry])
            self._out = np.array([max(x - rng.uniform(*self.LENGTH_M), 0.3 * reach), y, entry - closing])
            above = self.kinematics.strokes_at(x, self._surface + self.ABOVE_M, entry)
            fits = above is not None and self.line_fits(tuple(self._in), tuple(self._out), margin=0.02)
            if fits and above is not None and self.stays_above(above, self._surface + 0.1):
                return True
        return False

    def _curl(self, view: View) -> Array:
        """Close the bucket and lift it as far as possible."""
        rng = self._rng
        closed = math.radians(rng.uniform(*self.CURLED_DEG))
        tip = (view.tip_x, self._surface + rng.uniform(*self.LIFT_M), closed)
        strokes = self.kinematics.strokes_at(*tip)
        if strokes is None:
            strokes = np.array([min(1.0, view.strokes[0] + 0.3), view.strokes[1], 0.95])
        return self.stroke_leg(strokes, rng.uniform(*self.MOVE))

    def _dump(self, view: View) -> Array:
        """Return the strokes of an open bucket high above the ground, with a way there that stays above it."""
        rng = self._rng
        for _ in range(self.TRIES):
            x, y = rng.uniform(0.45, 0.85) * self.reach_m, self._surface + rng.uniform(*self.DUMP_M)
            strokes = self.kinematics.strokes_at(x, y, math.radians(rng.uniform(*self.OPEN_DEG)))
            if strokes is not None and self.stays_above(strokes, self._surface + 0.3):
                return strokes
        return np.array([min(view.strokes[0] + 0.2, 0.95), view.strokes[1], 0.1])

    def steer(self, view: View) -> None:
        """Return the levers of the drag: end with a full bucket, and raise the bucket at a stall."""
        if self._phase != DRAG:
            return
        if view.payload_kg > self._full_kg:
            self.end_leg()
        # The error at which a leg counts as blocked: the bucket is raised before the leg is given up.
        elif self.behind > 0.75 * self.WAITS_BEHIND:
            rise = self.RELIEF_RATE * self.step_s
            self._leg[tip_control.START + 1] += rise
            self._leg[tip_control.GOAL + 1] += rise
