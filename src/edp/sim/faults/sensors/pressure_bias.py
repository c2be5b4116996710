"""A pressure transmitter shows too much or too little."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import CHAMBERS, FAULTS, PRESSURE, SensorFault
from edp.sim.sensors import alterations, chain


class PressureBias(SensorFault):
    """An offset of one chamber's pressure, before range and converter."""

    text = "a cylinder pressure is shown with an offset"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} reads {size} too {high}"
    sites = CHAMBERS
    units = PRESSURE
    ladder = (1.0, 3.0, 10.0, 30.0)
    bound = span(-500.0, 500.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURES + CHAMBERS.index(site),)


FAULTS.register("pressure_bias")(PressureBias())
