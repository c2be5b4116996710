"""Three levers of the front, swing and travel at once."""

from __future__ import annotations

import numpy as np

from edp.sim.excitation.base import EXCITATIONS, MOTORS, Array, AxisStream
from edp.sim.excitation.combined import Combined
from edp.sim.machine.machine import Machine
from edp.sim.view import View


class MotorStream(AxisStream):
    """Lever of swing or travel: held longer than front levers, because of the larger mass."""

    HOLD_S = (0.6, 3.0)


@EXCITATIONS.register("six_levers")
class SixLevers(Combined):
    """Six independent levers: `combined` together with swing, left and right track."""

    swings = True
    MID_STROKE = 0.5
    """Stroke fraction used for swing and tracks, which have no end stops to avoid."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._streams += [MotorStream(rng, rate_hz) for _ in range(MOTORS)]

    def block(self, view: View) -> Array:
        """Return the levers up to the next change of any lever."""
        return self.samples_until_change([*view.strokes, *[self.MID_STROKE] * MOTORS])
