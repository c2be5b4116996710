"""A pressure transmitter is noisy."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import CHAMBERS, FACTOR, FAULTS, Array, SensorFault
from edp.sim.sensors import alterations, chain


class PressureNoise(SensorFault):
    """White noise of one transmitter increases by a factor; a noise-free transmitter stays noise-free."""

    text = "the noise of a cylinder pressure is larger by a factor"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} is noisy: by a factor of {size}"
    sites = CHAMBERS
    units = FACTOR
    ladder = (3.0, 10.0)
    bound = span(1.0, 1000.0)
    neutral = 1.0
    operation = alterations.NOISE

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURE_ERROR + CHAMBERS.index(site),)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        return sizes - 1.0


FAULTS.register("pressure_noise")(PressureNoise())
