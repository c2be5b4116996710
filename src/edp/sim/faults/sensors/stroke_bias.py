"""A stroke is shown with an offset."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, LENGTH, SensorFault
from edp.sim.sensors import alterations, chain


class StrokeBias(SensorFault):
    """An offset of one cylinder's stroke."""

    text = "a stroke is shown with an offset"
    part = "sensor of {axis} stroke"
    words = "stroke of the {axis} reads {size} too {high}"
    units = LENGTH
    ladder = (2.0, 5.0, 20.0)
    bound = span(-2000.0, 2000.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.STROKES + AXES.index(site),)


FAULTS.register("stroke_bias")(StrokeBias())
