"""Dig cycles that swing to dump, and travel on now and then: front, swing and tracks draw from the same pumps."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array
from edp.sim.excitation.dig import APPROACH, CURL, DUMP, Dig
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("swing_dig")
class SwingDig(Dig):
    """Dig cycles as in `dig`, which swing to a side while the bucket is lifted, dump there, and swing back.

    The swing lever is released when the remaining angle equals the braking angle. In some cycles the machine travels
    while it swings back, with a small difference between both tracks. The soil profile moves with the machine, so each
    dig starts from the ground of the previous dig.
    """

    swings = True
    SIDE_RAD = (0.8, 2.4)
    """Range of the swing angle for dumping to either side, rad (45 to 140 degrees)."""
    LEVEL = (0.55, 1.0)
    BRAKES_AT = 0.4
    """Swing deceleration with a closed valve that the operator expects, rad/s^2."""
    CLOSE_RAD, NEAR_RAD = 0.06, 0.25
    """Remaining swing angles (rad) at which the swing command ends, and at which the bucket is lowered or emptied."""
    TRAVELS = 0.3
    """Fraction of the cycles with travel."""
    TRAVEL_S, TRAVEL_LEVEL = (0.6, 2.5), (0.4, 1.0)

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._side, self._level = 0.0, 0.0
        self._travel_left_s = 0.0
        self._tracks = np.zeros(2)

    def next_leg(self, view: View) -> Array:
        """Return the motion of the next phase, or a wait until the swing arrives.

        Swing and travel follow the phase.
        """
        if self._phase in (APPROACH, CURL) and abs(self._swing_goal - view.swing) > self.NEAR_RAD:
            return self.stroke_leg(self._queue[-1], 1.0)
        leg = super().next_leg(view)
        rng = self._rng
        if self._phase == CURL:
            self._side = float(rng.choice((-1.0, 1.0)) * rng.uniform(*self.SIDE_RAD))
            self._level = float(rng.uniform(*self.LEVEL))
        if self._phase == APPROACH and rng.random() < self.TRAVELS:
            self._travel_left_s = float(rng.uniform(*self.TRAVEL_S))
            level = rng.choice((-1.0, 1.0)) * rng.uniform(*self.TRAVEL_LEVEL)
            self._tracks = np.clip(level * rng.uniform(0.9, 1.1, 2), -1.0, 1.0)
        return leg

    def block(self, view: View) -> Array:
        """Return the levers over one control step."""
        front = super().block(view)
        targets = np.zeros((len(front), self.levers()))
        targets[:, :AXES] = front
        targets[:, AXES] = self._swing_lever(view)
        if self._travel_left_s > 0.0:
            targets[:, AXES + 1 :] = self._tracks
            self._travel_left_s -= self.step_s
        return targets

    @property
    def _swing_goal(self) -> float:
        """The side while lifting and dumping, the dig otherwise."""
        return self._side if self._phase in (CURL, DUMP) else 0.0

    def _swing_lever(self, view: View) -> float:
        """Return the lever towards the goal, centred as soon as braking suffices."""
        left = self._swing_goal - view.swing
        braking = view.swing_rate * abs(view.swing_rate) / (2.0 * self.BRAKES_AT)
        # Angle to the goal that remains after braking to standstill.
        left -= braking
        return self._level * float(np.sign(left)) if abs(left) > self.CLOSE_RAD else 0.0
