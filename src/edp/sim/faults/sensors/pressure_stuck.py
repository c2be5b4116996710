"""A pressure transmitter shows the same value for ever."""

from __future__ import annotations

from edp.sim.faults.base import CHAMBERS, FAULTS, NO_UNIT, SensorFault
from edp.sim.sensors import alterations, chain


class PressureStuck(SensorFault):
    """One chamber's pressure stays at the value that was shown last."""

    text = "a cylinder pressure stays as it was"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} stays as it was"
    sites = CHAMBERS
    units = NO_UNIT
    operation = alterations.STUCK

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURES + CHAMBERS.index(site),)


FAULTS.register("pressure_stuck")(PressureStuck())
