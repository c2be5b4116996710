"""The gain of a pressure transmitter is wrong."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import CHAMBERS, FAULTS, SHARE, SensorFault
from edp.sim.sensors import alterations, chain


class PressureScale(SensorFault):
    """Scale error of one chamber pressure, before range limits and converter."""

    text = "a cylinder pressure is shown too large by a share"
    part = "sensor of {site} pressure"
    words = "{side} pressure of the {axis} reads {size} too {large}"
    sites = CHAMBERS
    units = SHARE
    ladder = (1.0, 3.0, 10.0)
    bound = span(-100.0, 100.0)
    operation = alterations.SCALE

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PRESSURES + CHAMBERS.index(site),)


FAULTS.register("pressure_scale")(PressureScale())
