"""A stroke shows the same value for ever."""

from __future__ import annotations

from edp.sim.faults.base import AXES, FAULTS, NO_UNIT, SensorFault
from edp.sim.sensors import alterations, chain


class StrokeStuck(SensorFault):
    """One cylinder's stroke stays at the value that was shown last."""

    text = "a stroke stays as it was"
    part = "sensor of {axis} stroke"
    words = "stroke of the {axis} stays as it was"
    units = NO_UNIT
    operation = alterations.STUCK

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.STROKES + AXES.index(site),)


FAULTS.register("stroke_stuck")(StrokeStuck())
