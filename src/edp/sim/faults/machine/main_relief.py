"""The main relief valve opens too early."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, PRESSURE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class MainRelief(MachineFault):
    """Its setting falls, though not below the pressure of the tank."""

    text = "the main relief valve opens too early; the size is the fall of its setting"
    part = "main relief valve"
    words = "the main relief valve opens {size} too early"
    sites = ()
    units = PRESSURE
    ladder = (20.0, 50.0, 100.0, 150.0)
    bound = span(0.0, 300.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        plant = numbers.plant
        plant[at.PUMP_RELIEF] = max(plant[at.PUMP_RELIEF] - size, plant[at.TANK])


FAULTS.register("main_relief")(MainRelief())
