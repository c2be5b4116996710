"""A velocity is shown with an offset."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, VELOCITY, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityBias(SensorFault):
    """An offset of one cylinder's velocity; its acceleration shows the step."""

    text = "a velocity is shown with an offset"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} reads {size} too {high}"
    units = VELOCITY
    ladder = (0.5, 2.0, 10.0)
    bound = span(-5000.0, 5000.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.VELOCITIES + AXES.index(site),)


FAULTS.register("velocity_bias")(VelocityBias())
