"""One cylinder at a time."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, AxisStream, Excitation
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("isolated")
class Isolated(Excitation):
    """One cylinder at a time, with pauses; the axis changes with every second move on average."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._stream = AxisStream(rng, rate_hz, pause=0.2)
        self._axis = 0

    def block(self, view: View) -> Array:
        """Return one move or pause of one axis."""
        if self._stream.hold.left == 0:
            if self._rng.random() < 0.5:
                self._axis = int(self._rng.integers(AXES))
                self._stream.axis = self._axis
            self._stream.next(view.strokes[self._axis])
        targets = np.zeros((self._stream.hold.left, AXES))
        targets[:, self._axis] = self._stream.level
        self._stream.hold.spend(len(targets))
        return targets

    def redraw(self, unused: int) -> None:
        """Draw a new random duration for the remainder of the current move."""
        self._stream.hold.redraw(unused)
