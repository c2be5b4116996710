"""The load checks of an axis do not close."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class CheckLeak(MachineFault):
    """Backward opening of load checks increases, in all sections of one axis."""

    text = "load checks of an axis let oil back; the size is the share of the opening that stays"
    part = "{axis} valve"
    words = "the load checks of the {axis} let oil back: {size} of the opening stay"
    grave = True
    units = SHARE
    ladder = (2.0, 5.0, 10.0, 15.0)
    bound = span(0.0, 100.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        i = AXES.index(site)
        numbers.axes[i, at.CHECK] = min(numbers.axes[i, at.CHECK] + size, 1.0)


FAULTS.register("check_leak")(CheckLeak())
