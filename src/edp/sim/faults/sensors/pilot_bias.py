"""A pilot pressure is shown with an offset."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.signals import TABLE_A1
from edp.sim.faults.base import FAULTS, PRESSURE, SensorFault
from edp.sim.sensors import alterations, chain

PILOTS = tuple(TABLE_A1)[12:]


class PilotBias(SensorFault):
    """Offset of one one-sided pilot pressure reading; the actual pilot pressure is unchanged."""

    text = "a pilot pressure is shown with an offset"
    part = "sensor of pilot pressure {site}"
    words = "pilot pressure {site} reads {size} too {high}"
    sites = PILOTS
    units = PRESSURE
    ladder = (0.5, 1.0, 3.0)
    bound = span(-50.0, 50.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PILOTS + PILOTS.index(site),)


FAULTS.register("pilot_bias")(PilotBias())
