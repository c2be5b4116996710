"""The line of a joint's sensor loses contact for single ticks."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, Array, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityDropouts(SensorFault):
    """Random single samples read 0; the size is their fraction."""

    text = "a velocity shows 0 for single ticks; the size is their share"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} drops to 0 at {size} of the ticks"
    units = SHARE
    ladder = (0.1, 1.0)
    bound = span(0.0, 100.0)
    operation = alterations.DROPOUT

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.VELOCITIES + AXES.index(site),)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        lost: Array = (chance.random(len(sizes)) < sizes).astype(float)
        return lost


FAULTS.register("velocity_dropouts")(VelocityDropouts())
