"""A velocity is shown late."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, TIME, Array, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityDelay(SensorFault):
    """A dead time of one cylinder's velocity; between ticks the value is interpolated."""

    text = "a velocity is shown late"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} is shown {size} late"
    units = TIME
    ladder = (10.0, 20.0, 50.0)
    bound = span(0.0, 1000.0)
    operation = alterations.DELAY

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.VELOCITIES + AXES.index(site),)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        return sizes * rate_hz


FAULTS.register("velocity_delay")(VelocityDelay())
