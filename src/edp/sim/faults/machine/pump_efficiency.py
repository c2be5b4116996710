"""A worn pump delivers less than its displacement."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, SHARE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class PumpEfficiency(MachineFault):
    """The volumetric efficiency decreases by a fraction."""

    text = "a pump delivers less; the size is the share that is lost"
    part = "{site}"
    words = "the flow of {site} is {size} too low"
    sites = ("pump_1", "pump_2", "both")
    units = SHARE
    ladder = (3.0, 6.0, 12.0, 25.0)
    bound = span(0.0, 90.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        if site != "pump_2":
            numbers.plant[at.EFFICIENCY] *= 1.0 - size
        if site != "pump_1":
            numbers.plant[at.EFFICIENCY_2] *= 1.0 - size


FAULTS.register("pump_efficiency")(PumpEfficiency())
