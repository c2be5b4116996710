"""A velocity is noisy."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FACTOR, FAULTS, Array, SensorFault
from edp.sim.sensors import alterations, chain


class VelocityNoise(SensorFault):
    """The white errors of one joint rate and of its velocity grow by a factor."""

    text = "the noise of a velocity is larger by a factor"
    part = "sensor of {axis} velocity"
    words = "velocity of the {axis} is noisy: by a factor of {size}"
    units = FACTOR
    ladder = (3.0, 10.0)
    bound = span(1.0, 1000.0)
    neutral = 1.0
    operation = alterations.NOISE

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return chain.RATE_ERROR + AXES.index(site), chain.VELOCITY_ERROR + AXES.index(site)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        return sizes - 1.0


FAULTS.register("velocity_noise")(VelocityNoise())
