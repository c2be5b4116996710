"""The oil's thermometer shows too much or too little."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, TEMPERATURE, SensorFault
from edp.sim.sensors import alterations, chain


class TemperatureOffset(SensorFault):
    """Offset of the oil temperature reading; the actual temperature is unchanged."""

    text = "the oil temperature is shown with an offset"
    part = "sensor of oil temperature"
    words = "oil temperature reads {size} too {high}"
    sites = ()
    units = TEMPERATURE
    ladder = (5.0, 15.0)
    bound = span(-100.0, 100.0)
    operation = alterations.OFFSET

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        return (chain.OIL,)


FAULTS.register("temperature_offset")(TemperatureOffset())
