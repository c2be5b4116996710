"""Fault: dirty oil cooler, or a stopped fan."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, SHARE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class Cooler(MachineFault):
    """Less heat flows from oil to air, so that the oil warms up over minutes."""

    text = "the oil cooler takes away less heat; the size is the share that is lost"
    part = "oil cooler"
    words = "the oil cooler takes away {size} less heat"
    sites = ()
    units = SHARE
    ladder = (50.0, 80.0, 100.0)
    bound = span(0.0, 100.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.plant[at.COOLING] *= 1.0 - size


FAULTS.register("cooler")(Cooler())
