"""The line of a pressure transmitter loses contact for single ticks."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import CHAMBERS, FAULTS, SHARE, Array, SensorFault
from edp.sim.sensors import alterations, chain


class PressureDropouts(SensorFault):
    """Random single samples read 0; the size is their fraction."""

    text = "a cylinder pressure shows 0 for single ticks; the size is their share"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} drops to 0 at {size} of the ticks"
    sites = CHAMBERS
    units = SHARE
    ladder = (0.1, 1.0)
    bound = span(0.0, 100.0)
    operation = alterations.DROPOUT

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURES + CHAMBERS.index(site),)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        lost: Array = (chance.random(len(sizes)) < sizes).astype(float)
        return lost


FAULTS.register("pressure_dropouts")(PressureDropouts())
