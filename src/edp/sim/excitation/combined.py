"""Three levers at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.sim.excitation.base import AXES, EXCITATIONS, Array, AxisStream, Excitation, held
from edp.sim.machine.machine import Machine
from edp.sim.view import View


@EXCITATIONS.register("combined")
class Combined(Excitation):
    """Three independent levers."""

    def __init__(self, rng: np.random.Generator, rate_hz: float, machine: Machine) -> None:
        super().__init__(rng, rate_hz, machine)
        self._streams = [AxisStream(rng, rate_hz, axis=axis) for axis in range(AXES)]

    def block(self, view: View) -> Array:
        """Return the levers up to the next change of any lever."""
        return self.samples_until_change(view.strokes)

    def samples_until_change(self, strokes: Sequence[float] | Array) -> Array:
        """Return the levers up to the next change, given each lever's position between its ends as a fraction."""
        for stream, stroke in zip(self._streams, strokes, strict=True):
            if stream.hold.left == 0:
                stream.next(stroke)
        samples = min(stream.hold.left for stream in self._streams)
        for stream in self._streams:
            stream.hold.spend(samples)
        return held([stream.level for stream in self._streams], samples)

    def redraw(self, unused: int) -> None:
        """Redraw the duration of each lever's hold."""
        for stream in self._streams:
            stream.hold.redraw(unused)
