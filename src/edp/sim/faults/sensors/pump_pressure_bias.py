"""A pump pressure is shown with an offset."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, PRESSURE, SensorFault
from edp.sim.sensors import alterations, chain


class PumpPressureBias(SensorFault):
    """An offset of one pump's delivery pressure."""

    text = "a pump pressure is shown with an offset"
    part = "sensor of {site} pressure"
    words = "pressure of {site} reads {size} too {high}"
    sites = ("pump_1", "pump_2")
    units = PRESSURE
    ladder = (3.0, 10.0, 30.0)
    bound = span(-500.0, 500.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.PUMPS + self.sites.index(site),)


FAULTS.register("pump_pressure_bias")(PumpPressureBias())
