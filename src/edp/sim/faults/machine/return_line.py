"""Something is in the way of the oil back to the tank, such as a clogged filter."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, PRESSURE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class ReturnLine(MachineFault):
    """The pressure of the return gallery rises, independent of the flow."""

    text = "the pressure of the return line is too high"
    part = "return line"
    words = "the pressure of the return line is {size} too high"
    sites = ()
    units = PRESSURE
    ladder = (2.0, 5.0, 10.0)
    bound = span(0.0, 50.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.plant[at.TANK] += size


FAULTS.register("return_line")(ReturnLine())
