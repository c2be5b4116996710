"""Fast sign flips."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, Excitation, Hold, extend_probability, held
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("reversals")
class Reversals(Excitation):
    """Sign flips every 0.15-0.6 s on one to three levers, in bursts of four to ten with pauses between."""

    FLIP_S = (0.15, 0.6)
    PAUSE_S = (0.2, 1.0)
    LEVELS = (0.3, 1.0)
    STRENGTH = (0.8, 0.65, 1.0)
    """Lever amplitude of the reversals for boom, arm and bucket. The bucket has the largest amplitude."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._hold = Hold(rng, rate_hz)
        self._flips = -1
        self._signs = np.zeros(AXES)
        self._levels = np.zeros(AXES)

    def block(self, view: View) -> Array:
        """Return one flip, or the pause after a burst."""
        if self._hold.left == 0:
            self._next(view)
        samples = self._hold.spend(self._hold.left)
        return held(self._levels, samples)

    def _next(self, view: View) -> None:
        rng = self._rng
        if self._flips == 0:
            self._flips, self._levels = -1, np.zeros(AXES)
            self._hold.start(*self.PAUSE_S)
            return
        if self._flips < 0:
            active = rng.random(AXES) < 0.5
            # At least one lever: a burst of none would be a second pause.
            active[rng.integers(AXES)] = True
            towards = [1.0 if rng.random() < extend_probability(s, 3.0) else -1.0 for s in view.strokes]
            self._signs = active * np.array(towards)
            self._flips = int(rng.integers(4, 11))
        self._levels = rng.uniform(*self.LEVELS, AXES) * self.STRENGTH * self._signs
        self._signs, self._flips = -self._signs, self._flips - 1
        self._hold.start(*self.FLIP_S)

    def redraw(self, unused: int) -> None:
        """Redraw the duration of the flip or pause."""
        self._hold.redraw(unused)
