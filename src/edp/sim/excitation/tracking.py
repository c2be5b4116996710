"""Closed loops on the bucket tip: a reference along legs, feed-forward through the inverse dead band, and PI."""

from __future__ import annotations

import numpy as np

from edp.sim import tip_control
from edp.sim.excitation.base import AXES, Array, Excitation
from edp.sim.excitation.levers import speed_table
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose
from edp.sim.view import View


class Tracked(Excitation):
    """Moves the tip along legs, one after another; subclasses choose the next leg in `next_leg`.

    A leg is a straight line of the tip at a linearly changing attitude, or of the three strokes. Its reference
    speeds up and slows down over at most `RAMP_S`, and waits while the cylinders are too far behind. Levers are the
    inverse of the measured lever-to-speed curves, dead band included, at the reference speed `LEAD_S` ahead (the
    machine answers that late) plus a PI correction of each stroke. The jump over the dead band at every change of sign
    causes a limit cycle of light axes, mainly of the bucket. Real machines show this limit cycle too, so it is
    intended.

    Args:
        rng: source of randomness.
        rate_hz: samples per second.
        machine: the machine that is moved.
    """

    CONTROL_HZ = 20.0
    """Rate of the controller, Hz. Each control step takes 33 us of Python (journal), so a higher rate slows the
    simulation."""
    RAMP_S = 0.5
    """Time to accelerate and to decelerate in each leg, s."""
    LEAD_S = 0.2
    PROPORTIONAL = 2.0
    """Proportional gain on the stroke error, 1/s."""
    INTEGRAL = 0.8
    """Integral gain on the stroke error, 1/s^2."""
    REST_SPEED = 0.004
    """Reference speed (m/s) below which the lever stays centred."""
    WAITS_BEHIND = 0.12
    """Stroke error (m) above which the reference waits."""
    PATIENCE_S = 1.5
    """Time (s) after which a blocked leg is abandoned and the boom is raised instead."""
    RESCUE = 0.15
    """Fraction of the boom stroke by which the boom is raised after a blocked leg."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._axes, plant = pack(machine)
        self.kinematics = pose.Kinematics(self._axes, plant)
        self.reach_m = float(self._axes[:, at.LENGTH].sum())
        levers, speeds = speed_table(machine)
        limits, scratch = self.kinematics.limits, np.zeros(pose.REACHED_VALUES)
        self._setup = (speeds, levers, self._axes, plant, limits, scratch)
        self._samples = max(1, round(rate_hz / self.CONTROL_HZ))
        step = self._samples / rate_hz
        self._gains = np.array(
            [self.RAMP_S, step, self.PROPORTIONAL, self.INTEGRAL, self.REST_SPEED, self.WAITS_BEHIND]
        )
        self._leg, self._begun = np.zeros(tip_control.LEG_VALUES), False
        self._memory, self._blocked = np.zeros(tip_control.MEMORY), 0.0
        self._queue = np.zeros((1 + max(1, round(self.LEAD_S / step)), AXES))

    def next_leg(self, view: View) -> Array:
        """Return the next motion after the last one is done; created with `cartesian_leg` or `stroke_leg`."""
        raise TypeError(f"{type(self).__name__} plans no legs; give it a `next_leg`")

    def steer(self, view: View) -> None:
        """Adjust the present motion to the view; the default has no effect."""

    def block(self, view: View) -> Array:
        """Return the levers over one control step, from the last ones in a straight line to the new ones."""
        memory = self._memory
        if not self._begun:
            self._begun = True
            self._queue[:] = view.strokes
            self._leg = self.next_leg(view)
        # The clock of the reference stops while the cylinders lag behind.
        elif memory[tip_control.TIME] >= self._leg[tip_control.LENGTH]:
            self._leg, memory[tip_control.TIME] = self.next_leg(view), 0.0
        self.steer(view)
        self._blocked = self._blocked + self.step_s if self.behind > 0.75 * self.WAITS_BEHIND else 0.0
        if self._blocked > self.PATIENCE_S:
            self._give_up(view)
        targets = np.empty((self._samples, AXES))
        tip_control.control(self._leg, view.strokes, self._queue, memory, self._gains, self._setup, targets)
        return targets

    def _give_up(self, view: View) -> None:
        """Let go of a leg that soil or an end blocks: forget errors, and raise the boom from where it is."""
        # Old references would move the cylinders back into the obstacle.
        self._blocked, self._queue[:] = 0.0, view.strokes
        self._memory[: tip_control.LEVER] = 0.0
        goal = view.strokes.copy()
        goal[0] = min(goal[0] + self.RESCUE, 0.97)
        self._leg = self.stroke_leg(goal, 0.2)

    @property
    def step_s(self) -> float:
        """Length of a control step."""
        return float(self._gains[tip_control.STEP])

    @property
    def behind(self) -> float:
        """Largest stroke error of the last control step, m."""
        return float(self._memory[tip_control.BEHIND])

    def end_leg(self) -> None:
        """End the current leg."""
        self._memory[tip_control.TIME] = self._leg[tip_control.LENGTH]

    def reference_pose(self) -> tuple[float, float, float]:
        """Return the tip pose at the newest reference."""
        return self.kinematics.pose_at(self._queue[-1])

    def line_fits(self, start: tuple[float, ...], goal: tuple[float, ...], margin: float = 0.04) -> bool:
        """Return whether all poses of a Cartesian motion are reachable with a `margin` (fraction of stroke)."""
        # Seven poses: strokes bend little along a straight leg.
        for q in np.linspace(0.0, 1.0, 7):
            x, y, attitude = (a + q * (b - a) for a, b in zip(start, goal, strict=True))
            strokes = self.kinematics.strokes_at(x, y, attitude)
            if strokes is None or strokes.min() < margin or strokes.max() > 1.0 - margin:
                return False
        return True

    def stays_above(self, goal: Array, floor: float) -> bool:
        """Return whether the tip stays above a height (m) on a stroke leg to `goal`."""
        start = self._queue[-1]
        return all(self.kinematics.pose_at(start + q * (goal - start))[1] > floor for q in (0.25, 0.5, 0.75, 1.0))

    def stroke_leg(self, goal: Array, speed: float) -> Array:
        """Return the motion from the present reference to strokes, with `speed` in fractions of stroke per second."""
        start = self._queue[-1]
        return np.array([*start, *goal, float(np.abs(goal - start).max()) / speed + self.RAMP_S, 0.0])

    def cartesian_leg(self, start: tuple[float, ...], goal: tuple[float, ...], length_s: float) -> Array:
        """Create a straight motion from one tip pose to another."""
        return np.array([*start, *goal, length_s, 1.0])
