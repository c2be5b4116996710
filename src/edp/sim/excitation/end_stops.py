"""Runs into cushions and stops."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, AxisStream, Excitation, Hold, extend_probability, held
from edp.sim.machine.machine import Machine
from edp.sim.view import View

PUSH, HOLD, MOVE = range(3)


@EXCITATIONS.register("end_stops")
class EndStops(Excitation):
    """Runs one cylinder into its cushion and stop, holds it there, and lets the others move in between."""

    STRETCH_S = 0.4
    """Length of one segment of a push, s. Short segments detect the end stop soon after contact."""
    HOLD_S = (0.5, 1.0)
    MAX_STRETCHES = 13
    """Maximum number of segments (5.2 s) after which a cylinder that does not reach its end stop is skipped."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._stream = AxisStream(rng, rate_hz)
        self._hold = Hold(rng, rate_hz)
        self._phase, self._runner, self._sign, self._pushed = PUSH, 0, 1.0, 0
        self._levels = np.zeros(AXES)

    def block(self, view: View) -> Array:
        """Return a part of the motion to the end stop, a hold of 0.5-1 s there, then a short combined move."""
        if self._hold.left == 0:
            self._next(view)
        samples = self._hold.spend(self._hold.left)
        return held(self._levels, samples)

    def _next(self, view: View) -> None:
        rng = self._rng
        share = view.strokes[self._runner]
        # A cylinder creeps the last half per cent behind its cushion.
        reached = (share if self._sign > 0 else 1.0 - share) > 0.995
        self._levels = np.zeros(AXES)
        if self._phase == HOLD:
            self._phase = MOVE
            for i in range(AXES):
                self._stream.next(view.strokes[i])
                self._levels[i] = self._stream.level
            # The runner rests meanwhile: the short move is one of the other two.
            self._levels[self._runner] = 0.0
            self._runner = int(rng.integers(AXES))
            self._sign = 1.0 if rng.random() < extend_probability(view.strokes[self._runner], 0.6) else -1.0
            self._pushed = 0
            self._hold.start(*AxisStream.HOLD_S)
        elif self._phase == PUSH and (reached or self._pushed >= self.MAX_STRETCHES):
            self._phase = HOLD
            self._levels[self._runner] = self._sign * rng.uniform(0.3, 0.8)
            self._hold.start(*self.HOLD_S)
        else:
            self._phase = PUSH
            self._pushed += 1
            self._levels[self._runner] = self._sign * rng.uniform(0.35, 1.0)
            self._hold.start(self.STRETCH_S, self.STRETCH_S)

    def redraw(self, unused: int) -> None:
        """Redraw the duration of a hold or move; a motion to the stop keeps its length."""
        self._hold.redraw(unused)
