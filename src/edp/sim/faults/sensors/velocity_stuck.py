"""A velocity shows the same value for ever."""

from __future__ import annotations

from edp.sim.faults.base import AXES, FAULTS, NO_UNIT, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityStuck(SensorFault):
    """One cylinder's velocity stays at the value that was shown last."""

    text = "a velocity stays as it was"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} stays as it was"
    units = NO_UNIT
    operation = alterations.STUCK

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.VELOCITIES + AXES.index(site),)


FAULTS.register("velocity_stuck")(VelocityStuck())
