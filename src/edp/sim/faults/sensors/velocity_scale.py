"""A velocity is shown too large or too small."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityScale(SensorFault):
    """Scale error of one cylinder velocity; its acceleration follows."""

    text = "a velocity is shown too large by a share"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} reads {size} too {large}"
    units = SHARE
    ladder = (1.0, 3.0, 10.0)
    bound = span(-100.0, 100.0)
    operation = alterations.SCALE

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.VELOCITIES + AXES.index(site),)


FAULTS.register("velocity_scale")(VelocityScale())
