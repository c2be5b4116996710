"""A pressure transmitter follows slowly, as behind a clogged line."""

from __future__ import annotations

import numpy as np

from edp.settings.bounds import span
from edp.sim.faults.base import CHAMBERS, FAULTS, TIME, Array, SensorFault
from edp.sim.sensors import alterations, chain


class PressureLag(SensorFault):
    """A first-order lag of one chamber's pressure."""

    text = "a cylinder pressure follows with a lag"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} follows with a lag of {size}"
    sites = CHAMBERS
    units = TIME
    ladder = (20.0, 50.0, 150.0)
    bound = span(0.0, 5000.0)
    operation = alterations.LAG

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURES + CHAMBERS.index(site),)

    def parameter(self, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """See `SensorFault.parameter`."""
        # What is left of a step after one tick; of a lag of nothing, nothing.
        left: Array = np.where(sizes > 0.0, np.exp(-1.0 / (rate_hz * np.maximum(sizes, 1e-9))), 0.0)
        return left


FAULTS.register("pressure_lag")(PressureLag())
