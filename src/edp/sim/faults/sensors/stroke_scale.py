"""A stroke is shown too large or too small."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, SensorFault
from edp.sim.sensors import alterations, chain


class StrokeScale(SensorFault):
    """Scale error of one cylinder stroke."""

    text = "a stroke is shown too large by a share"
    part = "sensor of {axis} stroke"
    words = "stroke of the {axis} reads {size} too {large}"
    units = SHARE
    ladder = (1.0, 3.0, 10.0)
    bound = span(-100.0, 100.0)
    operation = alterations.SCALE

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.STROKES + AXES.index(site),)


FAULTS.register("stroke_scale")(StrokeScale())
